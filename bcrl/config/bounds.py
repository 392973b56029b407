"""Limits on what is read, so that no input takes all memory, time or stack."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import yaml

from bcrl.errors import BcrlError, ConfigError

FILE_BYTES = 256 * 1024
NODES = 10_000  # of one YAML file, its aliases written out
DEPTH = 40  # of nested brackets, sections and keys
OVERRIDE = 10_000  # characters
JOBS = 1_000  # of one sweep
RESOLVED = 1_000_000  # characters and nodes, interpolations written out
CHAIN = 20  # interpolations that refer to one another
TOO_MUCH = f"nested too deeply, {CHAIN} interpolations in a row, or too much text"
#: The tags that JSON has, too; others make objects.
TAGS = {None, "!"} | {
    f"tag:yaml.org,2002:{kind}"
    for kind in ("null", "bool", "int", "float", "str", "seq", "map")
}
#: A reference, or one of the few resolvers that give text: the others (`oc.create`,
#: `oc.decode`, …) make config out of text, which nobody could check in advance.
INTERPOLATION = re.compile(
    r"\$\{\s*(?:(?P<key>[^\s${}:,]+)"
    r"|(?P<resolver>oc\.env|now|hydra|python_version)\s*:(?P<value>[^${}]*))\s*\}"
)
#: Scalars of YAML 1.1 that are seldom meant: octal, hexadecimal, base 60, with `_`.
TRUTH = re.compile("yes|no|on|off", re.IGNORECASE)
ODD_NUMBER = re.compile(r"[+-]?(0[bx][\da-f_]+|\d[\d_]*(:[0-5]?\d)*)(\.[\d_]*)?", re.I)
PLAIN = re.compile(r"[+-]?(0|[1-9]\d*)(\.\d*)?")
Keys = tuple[Any, ...]  # keys and indices from the root of a config


def check_override(text: str) -> None:
    """Raise BcrlError for an override that a parser would choke on."""
    short = repr(text if len(text) <= 60 else text[:57] + "…")
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise BcrlError(f"{short} isn't valid UTF-8") from error
    if len(text) > OVERRIDE:
        raise BcrlError(f"{short} is longer than {OVERRIDE} characters; use a YAML")
    depth = deepest = 0
    for character in text:
        depth += (character in "[({") - (character in "])}")
        deepest = max(deepest, depth)
    if max(deepest, text.partition("=")[0].count(".")) > DEPTH:
        raise BcrlError(f"{short} is nested more than {DEPTH} deep")


def check_file(path: Path) -> None:
    """Raise BcrlError for a YAML file that is no plain, small data in UTF-8."""
    if not path.is_file():  # a pipe would never end
        raise BcrlError(f"{path} is no regular file")
    if path.stat().st_size > FILE_BYTES:
        raise BcrlError(f"{path} is larger than {FILE_BYTES // 1024} KiB")
    try:
        check_yaml(path.read_text("utf-8"))
    except UnicodeDecodeError as error:
        raise BcrlError(f"{path} isn't UTF-8: {error.reason}") from error
    except yaml.YAMLError as error:
        raise BcrlError(
            f"{path} can't be read: {' '.join(str(error).split())}"
        ) from error
    except BcrlError as error:
        raise BcrlError(f"{path} {error}") from error


def check_yaml(text: str) -> None:
    """Raise BcrlError for YAML that expands, nests or makes objects out of bounds."""
    #: Of each collection that is open: its anchor, size and height.
    open_: list[list] = [[None, 0, 0]]
    anchors: dict[str, tuple[int, int]] = {}

    def add(size: int, height: int) -> None:
        open_[-1][1] += size
        open_[-1][2] = max(open_[-1][2], height + 1)
        if sum(level[1] for level in open_) > NODES:
            raise BcrlError(f"has more than {NODES} values, its aliases written out")
        if len(open_) + height > DEPTH:
            raise BcrlError(f"is nested more than {DEPTH} deep")

    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if getattr(event, "tag", None) not in TAGS:
            raise BcrlError(f"has the tag {event.tag!r}; only plain values can be read")
        if isinstance(event, yaml.AliasEvent):
            if any(level[0] == event.anchor for level in open_):
                raise BcrlError(f"has an alias of itself, *{event.anchor}")
            add(*anchors.get(event.anchor, (1, 0)))
        elif isinstance(event, yaml.CollectionStartEvent):
            add(1, 0)
            open_.append([event.anchor, 0, 0])
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, size, height = open_.pop()
            anchors[anchor] = (size + 1, height)
            open_[-1][1] += size
            open_[-1][2] = max(open_[-1][2], height + 1)
        elif isinstance(event, yaml.ScalarEvent):
            add(1, 0)
            anchors[event.anchor] = (1, 0)
            if event.implicit[0]:
                _check_plain(event.value)


def _check_plain(text: str) -> None:
    """Raise BcrlError for a plain scalar that YAML 1.1 reads as one wouldn't think."""
    if TRUTH.fullmatch(text):
        why = "write true or false, or quote on and off where they are names"
        raise BcrlError(f"has a bare {text}, a truth value to YAML; {why}")
    if ODD_NUMBER.fullmatch(text) and not PLAIN.fullmatch(text):
        if isinstance(read := yaml.safe_load(text), str):
            return
        why = "write the number that is meant in decimal digits, or quote a name"
        raise BcrlError(f"has a bare {text}, which YAML reads as {read!r}; {why}")


def check_interpolations(config: dict) -> None:
    """Raise BcrlError for interpolations that never end, or grow out of bounds."""
    known: dict[Keys, tuple[int, int]] = {}
    asked: list[Keys] = []  # references on the way to where we are

    def measure(path: Keys, node: Any) -> tuple[int, int]:
        """The size that a node resolves to, and how long a chain that takes."""
        if path in known:
            return known[path]
        if path in asked:
            raise BcrlError(f"{dotted(path)}: refers to itself")
        if len(asked) > DEPTH + CHAIN:
            raise BcrlError(f"{dotted(path)}: {TOO_MUCH}")
        size = height = 0
        asked.append(path)
        if isinstance(node, (dict, list)):
            inside = [measure((*path, k), v) for k, v in _items(node)]
            size = 1 + sum(each for each, _ in inside)
            height = max((each for _, each in inside), default=0)
        elif isinstance(node, str):
            size = 1 + len(node)
            found = references(path, node)
            if path[0] != "hydra" and any(map(_to_hydra, found)):
                why = "Hydra's own keys are known in jobs only; write what is meant"
                raise ConfigError(dotted(path), node, why)
            for resolved, chain in (refer(path, each) for each in found):
                size, height = size + resolved, max(height, 1 + chain)
        asked.pop()
        if height > CHAIN or size > RESOLVED:
            raise BcrlError(f"{dotted(path)}: {TOO_MUCH}")
        return known.setdefault(path, (size, height))

    def refer(path: Keys, found: re.Match) -> tuple[int, int]:
        if found["resolver"] == "oc.env":
            name = found["value"].partition(",")[0].strip()
            return len(os.environ.get(name, "")), 0
        if found["resolver"] not in (None, "hydra"):
            return 0, 0
        key = found["key"] or f"hydra.{found['value'].strip()}"
        there = _find(config, path, key)
        return measure(*there) if there else (0, 0)  # none: OmegaConf says so

    for key in sorted(config, key=lambda key: key == "hydra"):  # it repeats the others
        measure((key,), config[key])


def references(path: Keys, text: str) -> list[re.Match]:
    """The interpolations in `text`; ConfigError for one that isn't allowed."""
    found = [
        INTERPOLATION.match(text, each.start()) for each in re.finditer(r"\$\{", text)
    ]
    if None in found:
        why = "only ${key}, ${oc.env:NAME} and ${now:…}, not nested"
        raise ConfigError(
            dotted(path), text, f"this interpolation isn't allowed: {why}"
        )
    return found


def _to_hydra(found: re.Match) -> bool:
    return found["resolver"] == "hydra" or (found["key"] or "").startswith("hydra.")


def dotted(path: Keys) -> str:
    """The key as the user writes it."""
    return ".".join(map(str, path))


def _items(node: dict | list) -> Any:
    return node.items() if isinstance(node, dict) else enumerate(node)


def _find(
    config: dict, path: Keys, key: str, hops: int = CHAIN
) -> tuple[Keys, Any] | None:
    """Path and value of what `key` means at `path`, `.x` being relative."""
    dots = len(key) - len(key.lstrip("."))
    steps = [*(path[:-dots] if dots else ()), *re.findall(r"[^.\[\]]+", key)]
    here: Keys = ()
    node: Any = config
    for step in steps:
        while isinstance(node, str) and (onward := INTERPOLATION.fullmatch(node)):
            hops -= 1
            there = (
                _find(config, here, onward["key"], hops)
                if onward["key"] and hops > 0
                else None
            )
            if there is None:
                return None
            here, node = there
        inside = dict(_items(node)) if isinstance(node, (dict, list)) else {}
        if not (names := [name for name in inside if str(name) == str(step)]):
            return None
        here, node = (*here, names[0]), inside[names[0]]
    return here, node
