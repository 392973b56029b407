"""What each config key does, by its comment in conf/: `Text. Unit: …. Allowed: ….`"""

import re
import textwrap
from dataclasses import dataclass, field
from typing import Any

import yaml

from bcrl.common.identity import flat
from bcrl.config.hydra_compose import CONF
from bcrl.errors import BcrlError, closest

#: The groups whose options bring keys.
GROUPS = (
    *("env", "algorithm", "algorithm/regressor", "curriculum", "boosting", "transfer"),
    *("scale", "logger", "hydra/launcher"),
)
#: The groups whose options only choose or change what other groups bring.
SHORTHANDS = ("variant", "experiment", "debug")
KEY = re.compile(r"( *)([\w.]+):(?:\s|$)")
COMMENT = re.compile(r"(?:^|\s)#\s*(.*)$")
PARTS = re.compile(r"(.*?)(?:\s*Unit: (.*?)\.(?=\s|$))?(?:\s*Allowed: (.*)\.)?$")


@dataclass
class Entry:
    """A key with one meaning; it has several entries if options differ on it."""

    group: str
    key: str
    comment: str
    defaults: dict[str, Any] = field(default_factory=dict)  # option → value

    @property
    def parts(self) -> tuple[str, str, str]:
        """What the key does, its unit and the allowed values."""
        text, unit, allowed = PARTS.fullmatch(self.comment).groups("")  # type: ignore
        return text, unit, allowed

    @property
    def default(self) -> str:
        """The default, or each default with its options."""
        options: dict[str, list[str]] = {}
        for option, value in self.defaults.items():
            flow = yaml.safe_dump(value, default_flow_style=True, width=10**6)
            text = value if isinstance(value, str) else flow.split("\n")[0]
            options.setdefault("required" if text == "???" else text, []).append(option)
        each = [f"{value} ({', '.join(of)})" for value, of in options.items()]
        return "; ".join(each if len(each) > 1 else options)


def entries() -> list[Entry]:
    """All keys that a user can set, by group."""
    found = [e for group in ("", *GROUPS) for e in _of_group(group)]
    for path in sorted(CONF.glob("budget/*.yaml")):
        env, _, algorithm = path.stem.rpartition("_")
        budget = yaml.safe_load(path.read_text("utf-8"))
        for entry in (e for e in found if algorithm in e.defaults):
            if (key := entry.key.removeprefix("algorithm.")) in budget:
                entry.defaults[f"env={env}"] = budget[key]
    return found


def option_comments(group: str) -> dict[str, str]:
    """The options of a group, each with the comment that its file begins with."""
    found = {}
    for path in sorted(CONF.glob(f"{group}/*.yaml")):
        top = re.match(r"(?:#.*\n)*", path.read_text("utf-8"))[0]  # type: ignore
        lines = [x.lstrip("# ") for x in top.splitlines() if "@package" not in x]
        found[path.stem] = " ".join(lines)
    return found


def describe(word: str) -> str:
    """What a key does, or what a group or section has; "": a list of all keys."""
    key, known = word.partition("=")[0], entries()
    lines, chosen = [key], [entry for entry in known if entry.key == key]
    for entry in chosen:
        text, unit, allowed = entry.parts
        facts = [f"With {entry.group}={', '.join(entry.defaults)}:"] * (len(chosen) > 1)
        facts += [text, f"Default: {entry.default}."]
        facts += [f"Unit: {unit}."] * bool(unit)
        facts += [f"Allowed: {allowed}."] * bool(allowed)
        lines += (textwrap.fill(f"  {x}", 88, subsequent_indent="    ") for x in facts)
    if chosen:
        return "\n".join(lines)
    prefix = f"{key.replace('/', '.')}." if key else ""
    listed = option_comments(key) if key in (*GROUPS, *SHORTHANDS) else {}
    listed = {f"{key}={option}": text for option, text in listed.items()}
    for entry in (e for e in known if e.key.startswith(prefix)):
        listed.setdefault(entry.key, entry.parts[0].partition(". ")[0])
    if listed:
        return "\n".join(f"{name}: {text.rstrip('.')}" for name, text in listed.items())
    near = closest(key, [e.key for e in known])
    meant = f"did you mean {near}?" if near else "bcrl --describe lists all keys"
    raise BcrlError(f"--describe {key}: unknown key; {meant}")


def _of_group(group: str) -> list[Entry]:
    """A group's entries; a key without a comment joins the first entry of its name."""
    prefix = f"{group.replace('/', '.')}." if group else ""
    rows, found = [], list[Entry]()
    for path in sorted(CONF.glob(f"{group}/*.yaml" if group else "config.yaml")):
        text = path.read_text("utf-8")
        before = "" if not group or "@package _global_" in text else prefix
        comments = _comments(text)
        for name, value in flat(yaml.safe_load(text) or {}).items():
            key, skipped = f"{before}{name}", ("defaults", "_target_", "hydra")
            if name.split(".")[0] not in skipped and key.startswith(prefix):
                rows.append((comments.get(name), key, path.stem, value))
    for comment, key, option, value in sorted(rows, key=lambda row: row[0] is None):
        same = [e for e in found if e.key == key and comment in (None, e.comment)]
        if not same:
            same = [Entry(group, key, comment or "")]
            found += same
        same[0].defaults[option] = value
    return found


def _comments(text: str) -> dict[str, str]:
    """Dotted key → its comment: beside it and on the lines below."""
    found: dict[str, str] = {}
    stack: list[tuple[int, str]] = []
    for line in text.splitlines():
        comment = COMMENT.search(line)
        if key := KEY.match(line):
            stack = [x for x in stack if x[0] < len(key[1])] + [(len(key[1]), key[2])]
            name = ".".join(part for _, part in stack)
            found[name] = comment[1] if comment else ""
        elif found and comment and re.match(r"\s+#", line):
            found[name] = f"{found[name]} {comment[1]}".strip()
    return {name: text for name, text in found.items() if text.endswith(".")}
