"""What a wrong word of a command line probably means, as the words to type instead."""

from __future__ import annotations

import contextlib
import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from hydra.core.override_parser.types import RangeSweep
from omegaconf import OmegaConf

from bcrl.common.identity import Plain, flat
from bcrl.config.hydra_compose import (
    CONFIG_NAME,
    NO_ENV,
    Paths,
    Unknown,
    composed,
    group_names,
    options,
    read_option,
)
from bcrl.config.overrides import parse
from bcrl.config.safety import check_override
from bcrl.errors import BcrlError, closest

#: Other tools' words for our keys.
_TABLE = {
    "algorithm.learning_rate": "lr alpha step_size",
    "env.gamma": "discount gamma",
    "algorithm.regressor.trees": "n_estimators n_trees",
    "algorithm.replay_size": "buffer_size memory_size replay_buffer",
    "algorithm.steps": "total_timesteps timesteps n_steps max_steps num_steps",
    "algorithm.iterations": "n_iterations num_iterations iters",
    "algorithm.episodes": "n_episodes num_episodes",
    "algorithm.target_update": "target_update_interval target_update_freq",
    "algorithm.epsilon": "eps epsilon_greedy exploration",
    "algorithm.hidden": "net_arch hidden_sizes layers",
    "algorithm.batch_size": "batch",
    "env.horizon": "max_episode_steps",
    "workers": "n_jobs num_workers n_workers jobs processes",
    "threads": "n_threads num_threads",
    "seeds": "n_seeds num_seeds random_state random_seed",
    "runs_dir": "output out output_dir outdir log_dir logdir results save_dir",
    "tag": "name run_name exp_name",
    "env": "environment task game",
    "algorithm": "algo agent method",
    "experiment": "exp figure fig",
    "algorithm/regressor": "regressor model approximator",
    "hydra/launcher": "launcher",
    "checkpoint_every": "checkpoint save_every",
    "progress": "verbose log_level",
    "scale": "size budget_scale",
    "env.id": "env_id gym",
    "device": "use_cuda use_gpu cuda gpu use_device",
}
#: Whole words that are neither key nor value, and what they mean.
_WORDS = {
    "--help": "help ? usage man",
    "--version": "version v",
    "--status": "status ls list",
    "--dry-run": "dry_run dryrun n dry preview",
    "-m": "sweep multi m",
    "device=cuda": "cuda gpu",
    "device=cpu": "cpu",
    "debug=on": "debug",
    "progress=none": "quiet q silent",
    "--config-dir": "config config_file c",
    "hydra/launcher=slurm": "slurm",
    "workers=2": "local joblib",
    "logger=tensorboard": "tensorboard",
}
_ALIASES = {word: ours for ours, words in _TABLE.items() for word in words.split()}
_FLAGS = {word: ours for ours, words in _WORDS.items() for word in words.split()}
#: Other words for values: those of a key, those of any group.
_VALUES = {
    "device": {"gpu": "cuda", "true": "cuda", "yes": "cuda", "1": "cuda", "mps": "cpu"},
    "progress": {"false": "none", "off": "none", "true": "bar", "on": "bar"},
    "variant": {"fqi": "plain", "dqn": "plain", "none": "plain", "off": "plain"},
}
#: The groups whose options have keys.
_SECTIONS = (
    "env",
    "algorithm",
    "algorithm/regressor",
    "boosting",
    "transfer",
    "logger",
)
_YES, _NO = ("true", "yes", "1", "on"), ("false", "no", "0", "off", "none", "null")


@dataclass(frozen=True)
class Hints:
    """Suggestions for one command line: its overrides, and folders besides ours."""

    overrides: tuple[str, ...]
    folders: Paths = ()

    @cached_property
    def groups(self) -> dict[str, list[str]]:
        """The options of each group."""
        found = {
            name: options(name, self.folders) for name in group_names(self.folders)
        }
        return found | {"hydra/launcher": ["slurm"], "hydra/sweeper": ["basic"]}

    @cached_property
    def present(self) -> Plain:
        """The keys that there are with the same choices, and their values."""
        chosen = [o for o in self.overrides if o.partition("=")[0] in self.groups]
        for asked in (tuple(chosen), ("env=maze", *chosen), ("env=maze",)):
            with contextlib.suppress(BcrlError):
                job = composed(CONFIG_NAME, asked, self.folders)
                values: Any = OmegaConf.to_container(job)
                del values["hydra"]
                return {"seeds": None, "seed": None} | flat(values)
        return {}

    @cached_property
    def brought(self) -> dict[str, str]:
        """The keys that options bring into their section, and the first such option."""
        found: dict[str, str] = {}
        for group in _SECTIONS:
            for name in self.groups[group]:
                for key in flat(read_option(group, name, self.folders)):
                    whole = f"{group.replace('/', '.')}.{key}"
                    found.setdefault(whole, f"{group}={name}")
        return found

    @cached_property
    def spellings(self) -> dict[str, str]:
        """Groups and keys by what they may be called: parts left out, or a plural."""
        known = [*self.groups, *self.present, *self.brought]
        found: dict[str, str] = {}
        for name in known:
            found.setdefault(name.lower().replace("/", "."), name)
        for name in known:
            parts = re.split("[./]", name.lower())
            for form in (parts[-1], f"{parts[0]}.{parts[-1]}", ".".join(parts[-2:])):
                for spelled in (form, form.removesuffix("s"), f"{form}s"):
                    found.setdefault(spelled, name)
        return found

    def line(self, typed: str, value: str | None = None) -> str | None:
        """What to type for a key or a whole word, which may have its value."""
        key, equals, given = typed.lstrip("+~-").partition("=")
        text = given if equals else value
        norm = re.sub(r"[\s-]", "_", key.strip().lower())
        if text is None:
            return _FLAGS.get(norm) or self._word(key.strip())
        spelled = self.spellings
        forms = [name.replace("/", ".") for name in (_ALIASES.get(norm, norm), norm)]
        near = next((form for form in forms if form in spelled), None)
        near = near or closest(norm, spelled, 0.6)
        return self._with(spelled[near], text.strip()) if near else None

    def _with(self, key: str, value: str) -> str:
        """The key with its value, and before it the option that brings the key."""
        if key in ("env", "env.id") and (ours := gymnasium(value)):
            return ours
        if key in self.groups:
            return self._choice(key, value) or f"{key}={value or '…'}"
        value = _VALUES.get(key, {}).get(value.lower(), value)
        if key in ("seeds", "seed"):
            return numbers(key, value)
        option = "" if key in self.present else f"{self.brought[key]} "
        usual = self.present.get(key, "…")  # where none was typed
        value = value or str({None: "null", "???": "…"}.get(usual, usual))
        return f"{option}{key}={value}"

    def _word(self, word: str) -> str | None:
        """What to type for a word alone: `env=maze` for maze, `tag=x` for `tag: x`."""
        if split := re.match(r"([\w./-]+)\s*[: ]\s*=?\s*(\S+)$", word):
            return self.line(split[1], split[2])
        first = ("env", "variant", "experiment")
        for group in (*first, *self.groups):
            if word.lower() in map(str.lower, self.groups[group]):
                return self._choice(group, word)
        choices = (self._choice(group, word) for group in first)
        return gymnasium(word) or next(filter(None, choices), None)

    def _choice(self, group: str, value: object) -> str | None:
        """`env=maze`, the option of a group that a value means, if there is one."""
        known = {name.lower(): name for name in self.groups.get(group, ())}
        whole = str(value).strip("'\"[] ").lower().replace("-", "_")
        if group == "hydra/launcher" and whole in ("local", "joblib", "submitit_local"):
            return "workers=2"
        text = _VALUES.get(group, {}).get(whole, whole)
        text = text.replace("figure", "fig").removesuffix("_fqi").removesuffix("_dqn")
        forms = [text, f"fig{text}"]
        forms += ["on"] * (text in _YES) + ["off", "none"] * (text in _NO)
        forms += [name for name in known if len(text) > 2 and text in name]
        near = next((form for form in forms if form in known), None)
        near = near or closest(text, known, 0.5 if len(known) > 1 else 0.0)
        dqn = " algorithm=dqn" * (group == "variant" and whole.endswith("_dqn"))
        return f"{group}={known[near]}{dqn}" if near else None

    def check(self) -> None:
        """Raise BcrlError for a word that isn't KEY=VALUE, or another tool's value."""
        for word in self.overrides:
            check_override(word)
        for word, value in _bare(self.overrides):
            why = f"{word!r} can't be read as KEY=VALUE"
            raise BcrlError(f"{why}; {self.mean(word, value)}")
        for override in parse(self.overrides):
            key, given = override.key_or_group, override.value()
            typed = override.input_line
            raw = str(typed).partition("=")[2]
            text = isinstance(given, RangeSweep | str) and not raw.startswith("${")
            habit = _VALUES.get(key, {}) if key not in self.groups else {}
            if (key in ("seed", "seeds") and text) or str(given).lower() in habit:
                raise BcrlError(f"{typed}: did you mean {self._with(key, raw)}?")

    def swept(self) -> str:
        """What to say of several values without -m."""
        override = next(o for o in parse(self.overrides) if o.is_sweep_override())
        first, line = override.input_line, shlex.join(["bcrl", "-m", *self.overrides])
        if override.key_or_group.startswith("seed"):  # more likely one run of them
            meant = numbers("seeds", str(first))
            return f"{first}: did you mean {meant}? If a sweep: {line}"
        return f"{first}: several values are a sweep; add -m: {line}"

    def explained(self, error: Unknown) -> str:
        """What is wrong with an unknown key or option, and what to type."""
        key = error.key
        if error.option is not None:
            return f"{key}={error.option}: {self.of_option(key, error.option)}"
        if NO_ENV in str(error):
            return self._without_env()
        typed = [o for o in self.overrides if o.lstrip("+~").startswith(key)]
        value = typed[-1].partition("=")[2] if typed else ""
        if file := re.match(r"In '([^']*)'", str(error)):
            line = (self.line(key, "") or "").split(" ")[-1].partition("=")[0]
            nested = ": {".join(line.split(".")) + ": …" + "}" * line.count(".")
            if key in self.groups:
                nested = f"defaults: [override /{key}: …]"
            meant = f"did you mean {nested}?" if line else "see bcrl --help"
            return f"{key}: unknown key in {file[1]}; {meant}"
        if key in self.groups:
            why = "needs no +" if typed[-1][0] == "+" else "is chosen twice"
            return f"{key}: {why}; {self.mean(key, value)}"
        if typed and typed[0].startswith("~"):
            return f"{typed[0]}: there is nothing to delete; {key}=null"
        for parent in self.present.keys() - {"seed", "seeds"}:
            if key.startswith(f"{parent}."):
                inner, there = key.removeprefix(f"{parent}."), self.present[parent]
                line = f"+{key}={value}"
                if there is not None or parent.startswith("env.tasks."):
                    line = f"'{parent}=[{{{inner}: …}}, …]'"
                why = f"unknown key, for {parent} is {there or 'null'}"
                return f"{key}: {why}; did you mean {line}?"
        return f"{key}: unknown key; {self.mean(key, value)}"

    def _without_env(self) -> str:
        """What to type where no environment is chosen, perhaps by another's name."""
        for override in self.overrides:
            key, _, value = override.partition("=")
            known = key in self.groups or key in self.present
            if not known and not key.startswith(("+", "~", "hydra")):
                why = "needs its env" if key in self.brought else "unknown key"
                return f"{key}: {why}; {self.mean(key, value)}"
        known_envs = ", ".join(self.groups["env"])
        return f"env: You must specify 'env', such as env=maze; known: {known_envs}"

    def of_option(self, group: str, value: object) -> str:
        """`did you mean env=maze?`, and the options where they are few."""
        near = gymnasium(f"{group}/{value}".removeprefix("env/"))
        near, known = near or self._choice(group, value), self.groups.get(group, ())
        few = bool(known) and (len(known) <= 12 or not near)
        listed = f"known: {', '.join(known)}" if few else "see bcrl --help"
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


def _bare(words: Sequence[str]) -> Iterator[tuple[str, str | None]]:
    """The words that are no KEY=VALUE, each with the word that follows as its value."""
    for place, word in enumerate(words):
        if spaced := re.match(r"\s*([\w./]+)\s+=\s*(.*)$", word):
            yield spaced[1], spaced[2]
        if "=" in word.strip("=") or word.startswith("~"):
            continue
        after = [w for w in words[place + 1 : place + 3] if w != "="]
        is_value = after and "=" not in after[0] and not after[0].startswith("-")
        yield word, after[0] if is_value else None
