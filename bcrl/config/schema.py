"""The configuration's schema, and checks that name key, value and what is allowed."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Any, get_type_hints

from hydra_plugins.hydra_submitit_launcher.config import SlurmQueueConf
from omegaconf import MISSING, DictConfig, OmegaConf

from bcrl.common.checks import construct
from bcrl.common.identity import Plain, flat
from bcrl.errors import ConfigError, at_least

#: The choices that make a variant.
VARIANT_GROUPS = ("env", "algorithm", "curriculum", "boosting", "transfer", "scale")
_OF_SLURM = get_type_hints(SlurmQueueConf).items()
#: The keys whose values are text, those of Slurm's launcher among them.
TEXTS = {f"hydra.launcher.{k}" for k, hint in _OF_SLURM if hint in (str, str | None)}
TEXTS |= {
    "curriculum.name",
    "device",
    "extend",
    "keep",
    "progress",
    "runs_dir",
    "scale.name",
}
TEXTS |= {"seeds.part", "tag"}


@dataclass
class SeedsSection:
    """Which seeds a command runs."""

    first: int = 0
    count: int | None = 3  # null: those of `only`
    only: list[int] | None = None
    lockstep: int | None = None  # seeds that train together; null: the algorithm's
    part: str | None = None  # "2/5": the second of five parts of them; null: all


@dataclass
class Scale:
    """Caps on the budget of a slot."""

    name: str = MISSING
    max_iterations: int | None = None
    max_episodes: int | None = None
    max_steps: int | None = None


@dataclass
class Choice:
    """An option that has a name only."""

    name: str = MISSING


@dataclass
class Start:
    """The run whose agents the first stage starts from."""

    observation: str | None = None
    run: Any = None  # its environment's name, tag and config, read from its folder


@dataclass
class Config:
    """What `conf/` composes; sections of type Any are checked by their own classes."""

    env: Any = MISSING
    algorithm: Any = MISSING
    curriculum: Choice = field(default_factory=Choice)
    boosting: Any = MISSING
    transfer: Any = MISSING
    scale: Scale = field(default_factory=Scale)
    seeds: SeedsSection = field(default_factory=SeedsSection)
    workers: int = 1
    threads: int | None = None
    device: str = "cpu"
    runs_dir: str = "runs"
    tag: str | None = None
    progress: str = "auto"
    strict: bool = False
    logger: Any = field(default_factory=lambda: {"name": "none"})
    checkpoint_every: float = 60.0
    start: Any = field(default_factory=lambda: {"from": None, "observation": None})
    keep: str = "final"
    extend: str | None = None


def section_of_seeds(key: str, value: object) -> dict[str, Any]:
    """`seeds=5`, `seeds=[3,7]` and `seed=3` as keys of the section `seeds`."""
    if type(value) is int or (isinstance(value, str) and value.startswith("${")):
        return {"count": value} if key == "seeds" else {"count": None, "only": [value]}
    if isinstance(value, list) and not any(isinstance(x, (list, dict)) for x in value):
        return {"count": None, "only": list(value)}
    both = isinstance(value, Mapping) and None not in map(value.get, ("count", "only"))
    if isinstance(value, Mapping) and key == "seeds" and not both:
        return ({"count": None} if value.get("only") else {}) | dict(value)
    why = "how many (seeds=5), just these (seeds=[3,7,11]), or one (seed=3)"
    raise ConfigError(key, value, why)


def check_written(package: str, config: DictConfig) -> None:
    """Check a file's seeds and texts; `seeds: 5` becomes the keys of its section."""
    place = "" if package in ("", "_global_") else package.replace("/", ".") + "."
    values: Any = OmegaConf.to_container(config, resolve=False)
    named = [] if place else [k for k in ("seed", "seeds") if values.get(k) is not None]
    if len(named) == 2:
        raise ConfigError("seed", values["seed"], "seeds is given, too; keep one")
    for key in named:
        del config[key]
        values["seeds"] = section_of_seeds(key, values.pop(key))
        config["seeds"] = values["seeds"]
    for key, value in flat(values).items():
        if isinstance(value, (int, float)) and f"{place}{key}" in TEXTS:
            raise ConfigError(f"{place}{key}", value, "quote it where it is a name")


BASIC = {"_target_": "hydra._internal.core_plugins.basic_launcher.BasicLauncher"}


@dataclass
class _Slurm(SlurmQueueConf):
    seeds_per_job: int | None = None


def check_launcher(values: Plain | None) -> None:
    """Raise ConfigError for a launcher other than Slurm's, or a value it can't take."""
    values = {k: v for k, v in (values or {}).items() if v not in (None, [], {})}
    if values == BASIC:
        return
    if values.get("_target_") != SlurmQueueConf._target_:
        why = "can't be used; hydra/launcher=slurm, or workers=2 without a launcher"
        raise ConfigError("hydra.launcher._target_", values.get("_target_"), why)
    construct("hydra.launcher", _Slurm, values)
    for key, value in values.items():
        name, why = f"hydra.launcher.{key}", ""
        if key in ("setup", "additional_parameters"):
            why = "runs commands; leave it out"
        elif not re.fullmatch(r"[^\n\r;`()<>|&$]*", str(value)):
            why = "has characters of a shell"
        elif key.startswith("mem_per") and not re.fullmatch(r"\d+[KMGT]?B?", value):
            why = "must be a size such as 2G or 800M"
        if why:  # the values end in a shell script
            raise ConfigError(name, value, why)
        if type(value) is int:
            at_least(name, value, key not in ("max_num_timeout", "signal_delay_s"))
        if key == "submitit_folder":
            check_path(name, value)
    delay, limit = values.get("signal_delay_s", 0), values.get("timeout_min", math.inf)
    if delay >= 60 * limit:
        raise ConfigError("hydra.launcher.signal_delay_s", delay, "exceeds timeout_min")


def check_name(key: str, text: str) -> None:
    """Raise ConfigError for what isn't a plain name of a file or folder."""
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{,99}", text):
        why = "must be a plain name of at most 100 letters, digits, '.', '_' and '-'"
        raise ConfigError(key, text[:40], why)


def check_path(key: str, text: str) -> None:
    """Raise ConfigError for a path that leads out of this folder, or can't be made."""
    path = PurePath(text)
    longest = max((len(part.encode()) for part in path.parts), default=0)  # bytes
    for wrong, why in (
        (not text.strip(), "must name a folder"),
        (text.startswith("~"), "~ isn't expanded; write $HOME or the whole path"),
        (".." in path.parts and not path.is_absolute(), "leads out of this folder"),
        (not text.isprintable() or "://" in text, "isn't the name of a folder"),
        (longest > 200 or len(path.parts) > 50, "is too long for a path"),
    ):
        if wrong:
            raise ConfigError(key, repr(text[:40]) if "~" not in text else text, why)
