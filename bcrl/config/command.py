"""What is typed, in the one form that Hydra takes as it is meant.

Hydra guesses types: `tag=1e3` would be 1000.0. Here a name stays what was typed,
`seeds=5`, `seeds=[3,7]` and `seed=3` become keys, a folder outside becomes absolute.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import PurePath

from hydra.core.override_parser.types import ChoiceSweep, Glob

from bcrl.common.terminal import say
from bcrl.config.hydra_compose import Paths, group_names, now, options
from bcrl.config.overrides import parse
from bcrl.config.schema import NAME, section_of_seeds, texts
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


def canonical(overrides: Sequence[str], folders: Paths) -> list[str]:
    """The overrides as Hydra should read them; BcrlError for what can't be read.

    What is canonical stays as it is.
    """
    found: dict[str, None] = {}
    given = _without_local(overrides)
    for text in (text for each in given for text in _canonical(each, folders)):
        head = text.partition("=")[0]
        if head.startswith("seeds."):  # the last one holds
            found = {old: None for old in found if old.partition("=")[0] != head}
        found[text] = None
    return list(found)


def _without_local(overrides: Sequence[str]) -> list[str]:
    """The overrides, with workers in place of the former launcher `local`."""
    if "hydra/launcher=local" not in overrides:
        return list(overrides)
    typed = [o.partition("n_jobs=")[2] for o in overrides if "launcher.n_jobs=" in o]
    line = f"workers={next(filter(str.isdecimal, typed), os.cpu_count())}"
    say(f"hydra/launcher=local: this launcher is gone; the command runs with {line}")
    launcher = ("hydra/launcher=", "hydra.launcher.")
    chosen = [o for o in overrides if not o.startswith(launcher)]
    return chosen if any(o.startswith("workers=") for o in chosen) else [*chosen, line]


def _canonical(text: str, folders: Paths) -> Iterator[str]:
    text = NOW.sub(lambda found: now(found[1]), text)
    (override,) = parse([text])
    key, value = override.key_or_group, override.value()
    head, equals, raw = text.partition("=")
    is_group = key in group_names(folders)
    if override.is_delete() or not equals:
        yield text
    elif key in ("seed", "seeds") or (key == "seeds.only" and value is not None):
        yield from _seeds(key, value, raw)
    elif isinstance(value, Glob):
        names = value.filter(options(key, folders)) if is_group else []
        if not names:
            known = ", ".join(options(key, folders)) if is_group else "no group"
            why = f"glob(…) picks options of a group; {key} has {known}"
            raise ConfigError(key, raw, why)
        plain = all(map(NAME.fullmatch, names))
        yield f"{head}={','.join(names if plain else map(_quoted, names))}"
    elif COMPUTED.match(raw) or (is_group and isinstance(value, list)):
        yield text
    elif is_group or key in texts() or key.endswith((".name", ".id")):
        change = _within if key == "runs_dir" else _name
        named = _words(CHOICE.sub(r"\1\2", raw), change)
        yield f"{head}={named}" if named != raw else text
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
