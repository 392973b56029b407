"""What a wrong word of a command line probably means, as the words to type instead."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

from hydra.core.override_parser.types import IntervalSweep, Override, RangeSweep, Sweep
from omegaconf import OmegaConf

from bcrl.common.identity import flat
from bcrl.config.bounds import check_override
from bcrl.config.command import options
from bcrl.config.habits import ALIASES, ALONE, NO, VALUES, YES
from bcrl.config.hydra_compose import (
    CONFIG_NAME,
    NO_ENV,
    Folders,
    Unknown,
    composed,
    keys_of_options,
)
from bcrl.config.overrides import parse
from bcrl.errors import BcrlError, closest


@dataclass(frozen=True)
class Hints:
    """Suggestions for one command line: its overrides, and folders besides ours."""

    overrides: tuple[str, ...]
    folders: Folders = ()

    @cached_property
    def groups(self) -> dict[str, list[str]]:
        """The options of each group."""
        groups = [key for key, found in self.brought.items() if not found]
        return {group: options(group, self.folders) for group in groups}

    @cached_property
    def brought(self) -> dict[str, dict[str, object]]:
        """The keys that options bring."""
        return keys_of_options(self.folders)

    @cached_property
    def present(self) -> dict[str, object]:
        """The keys that there are with the same choices."""
        chosen = [o for o in self.overrides if o.partition("=")[0] in self.groups]
        for asked in (tuple(chosen), ("env=maze", *chosen), ("env=maze",)):
            try:
                job = OmegaConf.to_container(composed(CONFIG_NAME, asked, self.folders))
            except BcrlError:
                continue
            del job["hydra"]
            return {"seeds": None, "seed": None} | flat(job)
        return {}

    def words(self, typed: str, value: str | None = None) -> str | None:
        """What to type for a key or a whole word, which may have its value."""
        key, equals, given = typed.lstrip("+~-").partition("=")
        value = given if equals else value
        norm = re.sub(r"[\s-]", "_", key.strip().lower())
        if value is None and norm in ALONE:
            return ALONE[norm].format(norm)
        if value is None:
            return self._option_of_any(key)
        value = value.strip()
        if re.fullmatch(r"(use_)?(cuda|gpu)|.*device", norm) and re.match(
            "cuda|gpu|true|yes|1", value.lower()
        ):
            return "device=cuda"
        for name in dict.fromkeys((ALIASES.get(norm, norm), norm)):
            if (found := self._exact(name)) is not None:
                return self._with(found, value)
        near = self._like(norm)
        return None if near is None else self._with(near, value)

    def _exact(self, name: str) -> str | None:
        """The group or key that a name is, but for case, number, or parts left out."""
        candidates = [*self.groups, *self.present, *self.brought]
        slashed = name.replace(".", "/")
        for wanted in (name, slashed, name.removesuffix("s"), f"{name}s"):
            for known in candidates:
                if known.lower() == wanted:
                    return known
        for known in candidates:
            parts = iter(re.split("[./]", known.lower()))
            if known.lower().endswith(name.rpartition(".")[2]) and all(
                part in parts for part in name.split(".")
            ):
                return known
        return None

    def _like(self, name: str) -> str | None:
        """The group or key that is spelt most like a name, or whose last part is."""
        candidates = [*self.groups, *self.present, *self.brought]
        last = {re.split("[./]", known)[-1]: known for known in reversed(candidates)}
        near = closest(name, candidates, 0.6)
        if near is None and (part := closest(name.rpartition(".")[2], last, 0.7)):
            near = last[part]
        return near

    def _with(self, key: str, value: str) -> str:
        """The key with its value, and before it the option that brings the key."""
        if key in ("env", "env.id") and (ours := self.gymnasium(value)):
            return ours
        if key in self.groups:
            return f"{key}={self.option(key, value) or value or '…'}"
        value = VALUES.get(key, {}).get(value.lower(), value)
        if key in ("seeds", "seed"):
            return numbers(key, value)
        option = "" if key in self.present else f"{next(iter(self.brought[key]))} "
        usual = self.present.get(key, "…")  # where none was typed
        value = value or {None: "null", "???": "…"}.get(usual, usual)
        return f"{option}{key}={value}"

    def _option_of_any(self, word: str) -> str | None:
        """The option, of whatever group, that is called so, or nearly; else a flag."""
        split = re.match(r"([\w./-]+)\s*[: ]\s*=?\s*(\S+)$", word.strip())
        if split:
            return self.words(split[1], split[2])
        if ours := self.gymnasium(word):
            return ours
        first = ("env", "variant", "experiment")
        order = [*first, *(group for group in self.groups if group not in first)]
        for group in order:
            for option in self.groups[group]:
                if option.lower() == word.lower():
                    return f"{group}={option}"
        for group in order[:3]:
            if option := self.option(group, word):
                return f"{group}={option}"
        return None

    def gymnasium(self, value: str) -> str | None:
        """`env=gymnasium env.id=CartPole-v1` for such an id."""
        found = re.fullmatch(r"([\w.:/-]+)-v\d+", value)
        return f"env=gymnasium env.id={value}" if found else None

    def option(self, group: str, value: object) -> str | None:
        """The option that a value means."""
        known = self.groups.get(group, [])
        text = str(value).strip("'\"[] ").lower().replace("-", "_")
        text = VALUES.get(group, {}).get(text, text)
        if text in YES and "on" in known:
            return "on"
        if text in NO and {"off", "none"} & set(known):
            return "off" if "off" in known else "none"
        lower = {name.lower(): name for name in known}
        text = text.replace("figure", "fig").removesuffix("_fqi").removesuffix("_dqn")
        for form in (text, f"fig{text}", text.removeprefix("fig")):
            if form in lower:
                return lower[form]
        inside = [name for name in lower if len(text) > 2 and text in name]
        near = inside[0] if inside else closest(text, lower, 0.5)
        return lower[near] if near else None

    def refusals(self, parsed: Iterable[Override]) -> Iterator[str]:
        """A message for each override that no option, key or number answers to."""
        for override in parsed:
            key, value = override.key_or_group, override.value()
            typed = override.input_line
            head, _, raw = typed.partition("=")
            if isinstance(value, IntervalSweep):
                some = ",".join(self.groups.get(key, ())[:2])
                line = f"-m {head}={some or '0.1,0.5'}"
                yield f"{typed}: intervals are for optimisers; did you mean {line}?"
            elif key == "hydra/sweeper" and value != "basic":
                yield f"{typed}: the only one is basic; did you mean {key}=basic?"
            elif (
                key in ("seed", "seeds")
                and isinstance(value, (RangeSweep, str))
                and not raw.startswith("${")
            ):
                yield f"{typed}: did you mean {numbers(key, raw)}?"
            elif isinstance(value, Sweep) or override.is_delete():
                continue
            elif key in VALUES and str(value).lower() in VALUES[key]:
                yield f"{typed}: did you mean {key}={VALUES[key][str(value).lower()]}?"

    def check(self) -> None:
        """Raise BcrlError for a word that isn't KEY=VALUE, or another tool's value."""
        for word in self.overrides:
            check_override(word)
        for word, value in bare(self.overrides):
            raise BcrlError(
                f"{word!r} can't be read as KEY=VALUE; {self.mean(word, value)}"
            )
        for message in self.refusals(self._parsed()):
            raise BcrlError(message)

    def swept(self) -> str:
        """What to say of several values without -m."""
        several = [o for o in parse(self.overrides) if o.is_sweep_override()]
        first = several[0].input_line
        line = shlex.join(["bcrl", "-m", *self.overrides])
        text = f"{first}: several values are a sweep; add -m: {line}"
        if several[0].key_or_group in ("seed", "seeds"):  # more likely one run of them
            text = (
                f"{first}: did you mean {numbers('seeds', first)}? If a sweep: {line}"
            )
        return text

    def _parsed(self) -> Iterator[Override]:
        """The overrides; BcrlError for one that can't be read."""
        for override in self.overrides:
            key, _, value = override.partition("=")
            try:
                yield from parse([override])
            except BcrlError as error:
                line = f"{key}=$HOME{value[1:]}" if value.startswith("~") else ""
                if key in self.groups:
                    line = f"{key}={self.option(key, value) or self.groups[key][-1]}"
                hint = f"; did you mean {line}?" if line else ""
                raise BcrlError(f"{error}{hint}") from error

    def explained(self, error: Unknown) -> str:
        """What is wrong with an unknown key or option, and what to type."""
        if error.option is not None:
            known = self.of_option(error.key, error.option)
            return f"{error.key}={error.option}: {known}"
        if NO_ENV in str(error):
            return self.without_env()
        typed = [o for o in self.overrides if o.lstrip("+~").startswith(error.key)]
        value = typed[-1].partition("=")[2] if typed else ""
        if file := re.match(r"In '([^']*)'", str(error)):
            line = (self.words(error.key, "") or "").split(" ")[-1].partition("=")[0]
            nested = ": {".join(line.split(".")) + ": …" + "}" * line.count(".")
            if error.key in self.groups:
                nested = f"defaults: [override /{error.key}: …]"
            meant = f"did you mean {nested}?" if line else "see bcrl --help"
            return f"{error.key}: unknown key in {file[1]}; {meant}"
        if error.key in self.groups:
            why = "needs no +" if typed[-1][0] == "+" else "is chosen twice"
            return f"{error.key}: {why}; {self.mean(error.key, value)}"
        if typed and typed[0].startswith("~"):
            return f"{typed[0]}: there is nothing to delete; {error.key}=null"
        keys = self.present.keys() - {"seed", "seeds"}
        parents = [key for key in keys if error.key.startswith(f"{key}.")]
        if parents:
            inner = error.key.removeprefix(f"{parents[0]}.")
            line = f"+{error.key}={value}"
            if self.present[parents[0]] is not None or parents[0].startswith(
                "env.tasks."
            ):
                line = f"'{parents[0]}=[{{{inner}: …}}, …]'"
            why = f"{parents[0]} is {self.present[parents[0]] or 'null'}"
            return f"{error.key}: unknown key, for {why}; did you mean {line}?"
        return f"{error.key}: unknown key; {self.mean(error.key, value)}"

    def without_env(self) -> str:
        """What to type where no environment is chosen, perhaps by another's name."""
        for override in self.overrides:
            key, _, value = override.partition("=")
            known = {*self.groups, *self.present, *self.brought}
            if key not in known and not key.startswith(("+", "~", "hydra")):
                return f"{key}: unknown key; {self.mean(key, value)}"
            if self.brought.get(key) and key not in self.present:
                return f"{key}: needs its env; {self.mean(key, value)}"
        known = ", ".join(self.groups["env"])
        return f"env: You must specify 'env', such as env=maze; known: {known}"

    def of_option(self, group: str, value: object) -> str:
        """`did you mean env=maze?`, and the options where they are few."""
        if group[:3] == "env" and (line := self.gymnasium(str(value))):
            return f"did you mean {line}?"
        near, known = self.option(group, value), self.groups.get(group, ())
        if near and group == "variant" and str(value).upper().endswith("-DQN"):
            near += " algorithm=dqn"
        if not known:
            return f"{group} is no group; see bcrl --help"
        listed = f"known: {', '.join(known)}" if len(known) <= 12 or not near else ""
        said = f"did you mean {group}={near}?" if near else ""
        return f"{said} ({listed})" if said and listed else said or listed

    def mean(self, word: str, value: str | None) -> str:
        """`did you mean env=maze?`, or where to look."""
        line = self.words(word, value)
        return f"did you mean {line}?" if line else "see bcrl --help"


def numbers(key: str, value: str) -> str:
    """`seeds=5` or `seeds=[3,4,5]` for the ways in which people write ranges."""
    found = [int(number) for number in re.findall(r"\b\d{1,6}\b", value)]
    if "range" in value and len(found) == 1:
        return f"seeds={found[0]}"
    dashed = re.fullmatch(
        r"\[?(\d{1,6})\s*(-|\.\.|:|to|…)\s*(\d{1,6})\]?", value.strip()
    )
    if dashed or ("range" in value and len(found) == 2):
        first, last = found
        after = last if "range" in value or (dashed and dashed[2] == ":") else last + 1
        if first == 0:
            return f"seeds={after}"
        return f"seeds=[{','.join(map(str, range(first, min(after, first + 20))))}]"
    if len(found) > 1:
        return f"seeds=[{','.join(map(str, found))}]"
    return f"{key}={found[0]}" if found else "seeds=5 or seeds=[3,7,11]"


def bare(words: Sequence[str]) -> Iterator[tuple[str, str | None]]:
    """The words that are no KEY=VALUE, each with the word that follows as its value."""
    for place, word in enumerate(words):
        spaced = re.match(r"\s*([\w./]+)\s+=\s*(.*)$|=", word)
        if spaced and spaced[1]:
            yield spaced[1], spaced[2]
        if "=" in word.strip("=") or word.startswith("~"):
            continue
        after = [w for w in words[place + 1 : place + 3] if w != "="]
        plain = after and "=" not in after[0] and not after[0].startswith("-")
        yield word, after[0] if plain else None
