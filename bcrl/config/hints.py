"""What a wrong word of a command line probably means, as the words to type instead."""

import contextlib
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from typing import Any

import yaml
from hydra.core.override_parser.types import Glob, Override, RangeSweep, Sweep
from omegaconf import OmegaConf

from bcrl.common.identity import Plain, flat
from bcrl.config import hydra_compose as compose
from bcrl.config.describe import GROUPS, entries
from bcrl.config.overrides import parse
from bcrl.config.schema import Config
from bcrl.errors import BcrlError, closest

_READ = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text("utf-8"))
#: Another tool's word → ours: a key, what to type for a whole word, or a key's value.
_OURS = {
    table: {word: ours for ours, words in rows.items() for word in words.split()}
    for table, rows in _READ.items()
}


@dataclass(frozen=True)
class Hints:
    """Suggestions for one command line: its overrides, and folders besides ours."""

    overrides: tuple[str, ...]
    folders: compose.Paths = ()

    @cached_property
    def groups(self) -> dict[str, list[str]]:
        """The options of each group."""
        return compose.catalog(self.folders) | {"hydra/sweeper": ["basic"]}

    @cached_property
    def present(self) -> Plain:
        """The keys that there are with the same choices, and their values."""
        chosen = [o for o in self.overrides if o.partition("=")[0] in self.groups]
        for asked in (tuple(chosen), ("env=maze", *chosen), ("env=maze",)):
            with contextlib.suppress(BcrlError):
                job: Any = OmegaConf.to_container(compose.composed(asked, self.folders))
                return flat({key: job[key] for key in job if key != "hydra"})
        return {}

    @cached_property
    def brought(self) -> dict[str, str]:
        """The keys that options bring into their section, and the first such option."""
        known = [e for e in reversed(entries()) if e.group]
        found = {e.key: f"{e.group}={next(iter(e.defaults))}" for e in known}
        groups = [g for g in GROUPS if self.folders and g != "scale"]  # always there
        for group, name in ((g, o) for g in groups for o in self.groups[g]):
            for key in flat(compose.read_option(group, name, self.folders)):
                found.setdefault(f"{group.replace('/', '.')}.{key}", f"{group}={name}")
        return found

    @cached_property
    def spellings(self) -> dict[str, str]:
        """Groups and keys by what they may be called: parts left out, or a plural."""
        whole: dict[str, str] = {}
        for name in (*self.groups, "seed", "seeds", *self.present, *self.brought):
            whole.setdefault(name.lower().replace("/", "."), name)
        found = dict(whole)
        for spelled, name in whole.items():
            parts = spelled.split(".")
            for form in (parts[-1], f"{parts[0]}.{parts[-1]}", ".".join(parts[-2:])):
                for each in (form, form.removesuffix("s"), f"{form}s"):
                    found.setdefault(each, name)
        keys = _OURS["keys"].items()
        return found | {word: whole[ours] for word, ours in keys if ours in whole}

    def line(self, typed: str, value: str | None = None) -> str | None:
        """What to type for a key or a whole word, which may have its value."""
        key, equals, given = typed.lstrip("+~-").partition("=")
        text = given if equals else value
        word = re.sub(r"[\s-]", "_", key.strip().lower())
        if text is None:
            return _OURS["words"].get(word) or self._alone(key.strip())
        near = closest(word.replace("/", "."), self.spellings, 0.6)
        return self._with(self.spellings[near], text.strip()) if near else None

    def _alone(self, word: str) -> str | None:
        """What to type for a word alone: `env=maze` for maze, `tag=x` for `tag: x`."""
        if split := re.match(r"([\w./-]+)\s*[: ]\s*=?\s*(\S+)$", word):
            return self.line(split[1], split[2])
        order = (*self.groups, "experiment", "variant", "env")  # the last one holds
        known = {o.lower(): f"{g}={o}" for g in order for o in self.groups[g]}
        near = closest(word.lower(), known)
        return gymnasium(word) or (known[near] if near else None)

    def _with(self, key: str, value: str) -> str:
        """The key with its value, and before it the option that brings the key."""
        if key == "env.id" and (ours := gymnasium(value)):
            return ours
        if key in self.groups:
            return self._choice(key, value) or f"{key}={value or '…'}"
        if key in ("seeds", "seed"):
            return numbers(key, value)
        option = "" if key in self.present else f"{self.brought[key]} "
        value = _OURS.get(key, {}).get(value.lower(), value)
        usual = self.present.get(key, "…")  # where none was typed
        return f"{option}{key}={value or ('null' if usual is None else usual)}"

    def _choice(self, group: str, value: object) -> str | None:
        """`env=maze`, the option of a group that a value means, if there is one."""
        if ours := gymnasium(f"{group}/{value}".removeprefix("env/")):
            return ours
        known = {name.lower(): name for name in self.groups.get(group, ())}
        typed = str(value).strip("'\"[] ").lower().replace("-", "_")
        text = typed.removesuffix("_fqi").removesuffix("_dqn")
        text = _OURS.get(group, {}).get(text, text)
        if "=" in text:
            return text
        forms = [text, f"fig{text.removeprefix('figure')}"]
        forms += [name for name in known if len(text) > 2 and text in name]
        near = next((form for form in forms if form in known), closest(text, known))
        dqn = " algorithm=dqn" * (group == "variant" and typed.endswith("_dqn"))
        return f"{group}={known[near]}{dqn}" if near else None

    def check(self) -> None:
        """Raise BcrlError for a word that isn't KEY=VALUE, or another tool's value."""
        for place, word in enumerate(self.overrides):
            alone = "=" not in word.strip("=") and word[:1] != "~"
            if alone or re.match(r"\s*[\w./]+\s+=", word):
                meant = self.meant(self.overrides, place)
                raise BcrlError(f"{word!r} can't be read as KEY=VALUE; {meant}")
        parsed = parse(self.overrides)
        asked = [o.get_key_element() for o in parsed if o.key_or_group[:5] == "hydra"]
        for override in parsed:
            twice = asked.count(override.get_key_element()) > 1
            if why := "is given twice" if twice else self._wrong(override):
                raise BcrlError(f"{override.input_line}: {why}")

    def _wrong(self, override: Override) -> str | None:
        """Why not to type what Hydra would take without a word, or trip over."""
        key, value = override.key_or_group, override.value()
        raw = str(override.input_line).partition("=")[2]
        group, is_text = key.replace(".", "/"), isinstance(value, str)
        if override.is_delete():
            needed = key in Config.__annotations__
            return "every run needs a choice of it, or its default" if needed else None
        if key in self.groups and not isinstance(value, str | Sweep | Glob):
            return f"name one option, or leave {key} out; {self.of_option(key, value)}"
        if key == "tuned":
            return "follows from the other choices; override the keys themselves"
        optional = key in ("budget", "local")  # any option passes in Hydra
        if optional and isinstance(value, str | Sweep):
            for name in [value] if is_text else override.sweep_string_iterator():
                if name not in self.groups.get(key, ()):
                    return f"there is no {name}; {self.of_option(key, name)}"
        seeds = key in ("seed", "seeds") and (is_text or isinstance(value, RangeSweep))
        habits = {} if key in self.groups else _OURS.get(key, {})
        dotted = group != key and group in self.groups and is_text
        if (seeds and raw[:2] != "${") or str(value).lower() in habits or dotted:
            return f"did you mean {self._with(group if dotted else key, raw)}?"
        return None

    def meant(self, words: Sequence[str], place: int) -> str:
        """What a word that is neither KEY=VALUE nor a flag means; words may follow."""
        if spaced := re.match(r"\s*([\w./]+)\s+=\s*(.*)$", words[place]):
            return self.mean(spaced[1], spaced[2])
        rest = (word for word in words[place + 1 :] if word != "=")
        follow = takewhile(lambda word: "=" not in word and word[:1] != "-", rest)
        value = next(follow, None)
        if value and value.isdecimal():  # --seeds 0 1 2
            value = " ".join([value, *takewhile(str.isdecimal, follow)])
        return self.mean(words[place], value)

    def swept(self) -> str:
        """What to say of several values without -m."""
        swept = (o.input_line for o in parse(self.overrides) if o.is_sweep_override())
        first, line = str(next(swept)), shlex.join(["bcrl", "-m", *self.overrides])
        if first.startswith("seed"):  # more likely one run of them
            return f"{first}: did you mean {numbers('seeds', first)}? A sweep: {line}"
        return f"{first}: several values are a sweep; add -m: {line}"

    def explained(self, error: compose.Unknown) -> str:
        """What is wrong with an unknown key or option, and what to type."""
        key = error.key
        if error.option is not None:
            return f"{key}={error.option}: {self.of_option(key, error.option)}"
        if not key:  # perhaps it has another's name
            ours = {*self.groups, "seed", "seeds", *self.present}
            for key, _, value in (o.partition("=") for o in self.overrides):
                if key not in ours and not key.startswith(("+", "~", "hydra")):
                    why = "needs its env" if key in self.brought else "unknown key"
                    return f"{key}: {why}; {self.mean(key, value)}"
            return f"You must specify 'env'; {self.of_option('env', 'maze')}"
        typed = [o for o in self.overrides if o.lstrip("+~").startswith(key)]
        value = typed[-1].partition("=")[2] if typed else ""
        if file := re.match(r"In '([^']*)'", str(error)):
            near = (self.line(key, "") or key).split(" ")[-1].partition("=")[0]
            nested = near.replace(".", ": {") + ": …" + "}" * near.count(".")
            nested = f"defaults: [override /{key}: …]" if key in self.groups else nested
            return f"{key}: unknown key in {file[1]}; did you mean {nested}?"
        if key in self.groups:
            return f"{key}: needs no +, and is chosen once; {self.mean(key, value)}"
        if typed and typed[0].startswith("~"):
            return f"{typed[0]}: there is nothing to delete; {key}=null"
        nulls = (f"{k}." for k, there in self.present.items() if there is None)
        added = f"did you mean +{key}={value}?" if key.startswith(tuple(nulls)) else ""
        return f"{key}: unknown key; {added or self.mean(key, value)}"

    def of_option(self, group: str, value: object) -> str:
        """`did you mean env=maze?`, and the options."""
        near, known = self._choice(group, value), ", ".join(self.groups.get(group, []))
        return f"did you mean {near}? (known: {known})" if near else f"known: {known}"

    def mean(self, word: str, value: str | None) -> str:
        """`did you mean env=maze?`, or where to look."""
        line = self.line(word, value)
        return f"did you mean {line}?" if line else "see bcrl --help"


def gymnasium(value: str) -> str | None:
    """`env=gymnasium env.id=CartPole-v1` for such an id."""
    found = re.fullmatch(r"(?:gymnasium/)?([\w.:/-]+-v\d+)", value)
    return f"env=gymnasium env.id={found[1]}" if found else None


def numbers(key: str, value: str) -> str:
    """`seeds=5` or `seeds=[3,4,5]` for the ways in which people write ranges."""
    found = [int(number) for number in re.findall(r"\b\d{1,6}\b", value)]
    is_range = "range" in value
    if is_range or re.fullmatch(r"\[?\d+\s*(-|\.\.|:|to|…)\s*\d+\]?", value.strip()):
        first, last = [0, 0, *found][-2:]
        after = last if is_range or ":" in value else last + 1
        if first == 0:
            return f"seeds={after}"
        found = list(range(first, min(after, first + 20)))
    if len(found) > 1:
        return f"seeds=[{','.join(map(str, found))}]"
    return f"{key}={found[0]}" if found else "seeds=5 or seeds=[3,7,11]"
