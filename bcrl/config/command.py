"""What is typed, in the one form that Hydra takes as it is meant.

Hydra guesses types: `tag=1e3` would be 1000.0. Here a name stays what was typed,
`seeds=5`, `seeds=[3,7]` and `seed=3` become keys, a folder outside becomes absolute.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path, PurePath
from typing import Any

from hydra.core.override_parser.types import ChoiceSweep, Glob

from bcrl.config import guard
from bcrl.config.hydra_compose import CONF, Folders, keys_of_group
from bcrl.config.overrides import parse
from bcrl.config.safety import NAME
from bcrl.config.schema import section_of_seeds, texts
from bcrl.errors import ConfigError

#: A quoted string, or bare text up to what ends it.
WORD = re.compile(
    r"(?P<quoted>'(?:\\.|[^'\\])*'|\"(?:\\.|[^\"\\])*\")"
    r"|(?P<bare>(?:\$\{[^{}]*\}|[^,\[\](){}'\"$]|\$(?!\{))+)"
)
#: Functions whose arguments are no names, and what Hydra may take for a number.
CHOICE = re.compile(r"^\s*(?:choice\((.*)\)|(?:shuffle|sort)\(([^()=]*)\))\s*$")
NOW = re.compile(r"\$\{now:([^{}]*)\}")
COMPUTED = re.compile(r"\s*(range|interval|glob|int|float|bool|str|json_str)\s*\(")
NUMBER = re.compile(r"[+-]?[\d.][\w.+-]*|[+-]?(nan|inf)|true|false", re.IGNORECASE)


def canonical(overrides: Sequence[str], folders: Folders) -> list[str]:
    """The overrides as Hydra should read them; BcrlError for what can't be read.

    What is canonical stays as it is.
    """
    found: dict[str, None] = {}
    for text in (text for each in overrides for text in _canonical(each, folders)):
        head = text.partition("=")[0]
        if head.startswith("seeds."):  # the last one holds
            found = {old: None for old in found if old.partition("=")[0] != head}
        found[text] = None
    return list(found)


def options(group: str, folders: Folders) -> list[str]:
    """The names of a group's options."""
    places = [Path(folder, group) for folder in (CONF, *folders)]
    return sorted({path.stem for place in places for path in place.glob("*.yaml")})


def _canonical(text: str, folders: Folders) -> Iterator[str]:
    text = NOW.sub(lambda found: guard.now(found[1]), text)
    (override,) = parse([text])
    key, value = override.key_or_group, override.value()
    head, equals, raw = text.partition("=")
    if override.is_delete() or not equals:
        yield text
    elif key in ("seed", "seeds") or (key == "seeds.only" and value is not None):
        yield from _seeds(key, value, raw)
    elif isinstance(value, Glob):
        if not _is_group(key, folders):
            raise ConfigError(key, raw, "glob(…) picks options of a group; list values")
        names = value.filter(options(key, folders))
        if not names:
            why = f"matches none of {key}'s options"
            raise ConfigError(key, raw, f"{why}: {', '.join(options(key, folders))}")
        plain = all(map(NAME.fullmatch, names))
        yield f"{head}={','.join(names if plain else map(_quoted, names))}"
    elif isinstance(value, list) and _is_group(key, folders):
        yield text  # no option: refused as it was typed
    elif key == "hydra.searchpath":
        yield f"{head}={_words(raw, _folder)}"
    elif (
        not COMPUTED.match(raw)
        and (
            named := _words(
                CHOICE.sub(r"\1\2", raw), _within if key == "runs_dir" else _name
            )
        )
        != raw
    ):
        yield f"{head}={named}" if _is_text(key, folders) else text
    else:
        yield text


def _seeds(key: str, value: object, raw: str) -> Iterator[str]:
    """`seeds=5`, `seeds=[3,7]`, or a sweep of one of these, by the section's keys."""
    values = list(value.list) if isinstance(value, ChoiceSweep) else [value]
    sections = [section_of_seeds(key, each) for each in values]
    if len({tuple(section) for section in sections}) > 1:
        raise ConfigError(key, raw, "sweep over either numbers or lists")
    for name in sections[0]:
        each = [str(section[name]).replace(" ", "") for section in sections]
        yield f"seeds.{name}={'null' if each[0] == 'None' else ','.join(each)}"


def _words(raw: str, change: Callable[[str, bool], str | None]) -> str:
    """A value, its strings changed where `change` gives another."""

    def changed(found: re.Match) -> str:
        text = found["bare"] or re.sub(r"\\(['\"])", r"\1", found["quoted"][1:-1])
        other = change(text.strip(), bool(found["quoted"]))
        return found[0] if other is None else _quoted(other)

    return WORD.sub(changed, raw)


def _quoted(text: str) -> str:
    return '"' + text.replace('"', r"\"") + '"'


def _name(text: str, quoted: bool) -> str | None:
    """The text, if Hydra would take it for a number or a truth value."""
    if quoted or not NUMBER.fullmatch(text):
        return None
    (found,) = parse([f"x={text}"])
    return None if isinstance(found.value(), str) else text


def _within(text: str, quoted: bool) -> str | None:
    """A folder that was typed and leads out of this one, as an absolute path."""
    leads_out = ".." in PurePath(text).parts and not os.path.isabs(text)
    return os.path.realpath(text) if leads_out else _name(text, quoted)


def _folder(text: str, quoted: bool) -> str | None:
    path = text.removeprefix("file://")
    if "://" in path or os.path.isabs(path) or not path:
        return None
    return f"file://{os.path.abspath(path)}"


def _is_group(key: str, folders: Folders) -> bool:
    return any(Path(folder, key).is_dir() for folder in (CONF, *folders))


def _is_text(key: str, folders: Folders) -> bool:
    """Whether a key's value is text by the schema, or by an option that has the key."""
    if key in texts() or _is_group(key, folders):
        return True
    parts = key.split(".")
    groups = ["/".join(parts[:n]) for n in range(1, len(parts))]
    shipped = [keys_of_group(group, folders).get(key, {}) for group in groups]
    named = [each for found in shipped for v in found.values() for each in _parts(v)]
    # YAML reads 1e-4 as text, too.
    return any(
        isinstance(v, str) and "${" not in v and not NUMBER.fullmatch(v) for v in named
    )


def _parts(value: Any) -> list:
    return value if isinstance(value, list) else [value]
