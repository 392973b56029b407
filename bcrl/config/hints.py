"""What a wrong word of a command line probably means, as the words to type instead."""

import contextlib
import re
import shlex
from collections.abc import Mapping, Sequence
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
from bcrl.config.overrides import parse
from bcrl.config.schema import Config
from bcrl.errors import BcrlError, closest

#: Groups that Hydra would take any option of, known or not.
OPTIONAL = ("budget", "tuned", "local")
#: The groups whose options have keys.
_SECTIONS = ("env", "algorithm", "algorithm/regressor", "boosting", "transfer")


def _by_word(table: Mapping[str, str]) -> dict[str, str]:
    return {word: ours for ours, words in table.items() for word in words.split()}


_READ = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text("utf-8"))
#: Another tool's word → our key; a whole word → what to type; key → word → our value.
_KEYS, _WORDS = _by_word(_READ["keys"]), _by_word(_READ["words"])
_VALUES = {key: _by_word(table) for key, table in _READ["values"].items()}


@dataclass(frozen=True)
class Hints:
    """Suggestions for one command line: its overrides, and folders besides ours."""

    overrides: tuple[str, ...]
    folders: compose.Paths = ()

    @cached_property
    def groups(self) -> dict[str, list[str]]:
        """The options of each group."""
        names = compose.group_names(self.folders)
        found = {name: compose.options(name, self.folders) for name in names}
        return found | {"hydra/launcher": ["slurm"], "hydra/sweeper": ["basic"]}

    @cached_property
    def present(self) -> Plain:
        """The keys that there are with the same choices, and their values."""
        chosen = [o for o in self.overrides if o.partition("=")[0] in self.groups]
        for asked in (tuple(chosen), ("env=maze", *chosen), ("env=maze",)):
            with contextlib.suppress(BcrlError):
                job = compose.composed(asked, self.folders)
                values: Any = OmegaConf.to_container(job)
                return flat({key: values[key] for key in values if key != "hydra"})
        return {}

    @cached_property
    def brought(self) -> dict[str, str]:
        """The keys that options bring into their section, and the first such option."""
        found: dict[str, str] = {}
        for group in _SECTIONS:
            for name in self.groups[group]:
                for key in flat(compose.read_option(group, name, self.folders)):
                    whole = f"{group.replace('/', '.')}.{key}"
                    found.setdefault(whole, f"{group}={name}")
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
        return found | {w: whole[ours] for w, ours in _KEYS.items() if ours in whole}

    def line(self, typed: str, value: str | None = None) -> str | None:
        """What to type for a key or a whole word, which may have its value."""
        key, equals, given = typed.lstrip("+~-").partition("=")
        text = given if equals else value
        word = re.sub(r"[\s-]", "_", key.strip().lower())
        if text is None:
            return _WORDS.get(word) or self._alone(key.strip())
        near = closest(word.replace("/", "."), self.spellings, 0.6)
        return self._with(self.spellings[near], text.strip()) if near else None

    def key(self, word: str) -> str:
        """The key or group that a word means, or ""."""
        return (self.line(word, "") or "").split(" ")[-1].partition("=")[0]

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
        usual = self.present.get(key, "…")  # where none was typed
        value = _VALUES.get(key, {}).get(value.lower(), value)
        value = value or str({None: "null", "???": "…"}.get(usual, usual))
        return f"{option}{key}={value}"

    def _choice(self, group: str, value: object) -> str | None:
        """`env=maze`, the option of a group that a value means, if there is one."""
        if ours := gymnasium(f"{group}/{value}".removeprefix("env/")):
            return ours
        known = {name.lower(): name for name in self.groups.get(group, ())}
        typed = str(value).strip("'\"[] ").lower().replace("-", "_")
        text = typed.removesuffix("_fqi").removesuffix("_dqn")
        text = _VALUES.get(group, {}).get(text, text)
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
        for override in parse(self.overrides):
            if why := self._wrong(override):
                raise BcrlError(f"{override.input_line}: {why}")

    def _wrong(self, override: Override) -> str | None:
        """Why not to type what Hydra would take without a word, or trip over."""
        key, value = override.key_or_group, override.value()
        raw = str(override.input_line).partition("=")[2]
        group, is_text = key.replace(".", "/"), isinstance(value, str)
        if override.is_delete():
            why = "can't be deleted: every run needs a choice of it, or its default"
            return why if key in Config.__annotations__ else None
        if key in self.groups and not isinstance(value, str | Sweep | Glob):
            return f"name one option, or leave {key} out; {self.of_option(key, value)}"
        if key in OPTIONAL and isinstance(value, str | Sweep):
            swept = isinstance(value, Sweep)
            for name in override.sweep_string_iterator() if swept else [value]:
                if name not in self.groups.get(key, ()):
                    return f"there is no {name}; {self.of_option(key, name)}"
        seeds = key in ("seed", "seeds") and (is_text or isinstance(value, RangeSweep))
        habits = {} if key in self.groups else _VALUES.get(key, {})
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
        override = next(o for o in parse(self.overrides) if o.is_sweep_override())
        first, line = override.input_line, shlex.join(["bcrl", "-m", *self.overrides])
        if override.key_or_group.startswith("seed"):  # more likely one run of them
            meant = numbers("seeds", str(first))
            return f"{first}: did you mean {meant}? If a sweep: {line}"
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
            near = self.key(key)
            nested = ": {".join(near.split(".")) + ": …" + "}" * near.count(".")
            if key in self.groups:
                nested = f"defaults: [override /{key}: …]"
            meant = f"did you mean {nested}?" if near else "see bcrl --help"
            return f"{key}: unknown key in {file[1]}; {meant}"
        if key in self.groups:
            why = "needs no +" if typed[-1][0] == "+" else "is chosen twice"
            return f"{key}: {why}; {self.mean(key, value)}"
        if typed and typed[0].startswith("~"):
            return f"{typed[0]}: there is nothing to delete; {key}=null"
        for parent, there in self.present.items():
            if key.startswith(f"{parent}."):
                line = f"+{key}={value}"
                if there is not None or parent.startswith("env.tasks."):
                    line = f"'{parent}=[{{{key[len(parent) + 1 :]}: …}}, …]'"
                why = f"unknown key, for {parent} is {there or 'null'}"
                return f"{key}: {why}; did you mean {line}?"
        return f"{key}: unknown key; {self.mean(key, value)}"

    def of_option(self, group: str, value: object) -> str:
        """`did you mean env=maze?`, and the options."""
        near, known = self._choice(group, value), self.groups.get(group)
        listed = f"known: {', '.join(known)}" if known else "see bcrl --help"
        return f"did you mean {near}? ({listed})" if near else listed

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
