"""The configuration's schema, and checks that name key, value and what is allowed."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, get_args, get_origin, get_type_hints

from hydra.conf import HydraConf
from hydra.core.config_store import ConfigStore
from hydra_plugins.hydra_joblib_launcher.config import JobLibLauncherConf
from hydra_plugins.hydra_submitit_launcher.config import SlurmQueueConf
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from bcrl.errors import ConfigError, did_you_mean


@dataclass
class Seeds:
    first: int = 0
    count: int | None = 3  # null: those of `only`
    only: list[int] | None = None
    lockstep: int | None = None  # seeds that train together; null: the algorithm's
    part: str | None = None  # "2/5": the second of five parts of them; null: all


@dataclass
class Scale:
    name: str = MISSING
    max_iterations: int | None = None  # caps a slot's budget
    max_episodes: int | None = None
    max_steps: int | None = None


@dataclass
class Choice:
    name: str = MISSING


@dataclass
class Config:
    """What `conf/` composes; sections of type Any are checked by their own classes."""

    env: Any = MISSING
    algorithm: Any = MISSING
    curriculum: Choice = field(default_factory=Choice)
    boosting: Any = MISSING
    transfer: Any = MISSING
    scale: Scale = field(default_factory=Scale)
    seeds: Seeds = field(default_factory=Seeds)
    workers: int = 1
    threads: int | None = None
    device: str = "cpu"
    runs_dir: str = "runs"
    tag: str | None = None
    progress: str = "auto"
    strict: bool = False
    logger: Any = field(default_factory=lambda: {"name": "none"})
    checkpoint_every: float = 60.0


def register() -> None:
    """Make the schema known to Hydra as `schema`."""
    ConfigStore.instance().store(name="schema", node=Config)


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


def seeds_of(config: Any) -> None:
    """Write a file's `seeds: 5`, `seeds: [3, 7]` or `seed: 3` as the section's keys."""
    there = config if isinstance(config, DictConfig) else {}
    if None not in (there.get("seed"), there.get("seeds")):
        raise ConfigError("seed", there["seed"], "seeds is given, too; keep one")
    for key in ("seed", "seeds"):
        if there.get(key) is not None:
            value = OmegaConf.to_container(config, resolve=False).pop(key)
            del config[key]
            config["seeds"] = section_of_seeds(key, value)


LAUNCHERS = {"JoblibLauncher": JobLibLauncherConf, "SlurmLauncher": SlurmQueueConf}


@cache
def texts() -> frozenset[str]:
    """The keys that a schema declares as text, ours, Hydra's and its launchers'."""
    found = {*_texts(Config, ""), *_texts(HydraConf, "hydra.")}
    for launcher in LAUNCHERS.values():
        found |= {*_texts(launcher, "hydra.launcher.")}
    return frozenset(found)


def _texts(cls: type, prefix: str) -> Iterator[str]:
    for name, hint in get_type_hints(cls).items():
        if str in (hint, *get_args(hint)) and get_origin(hint) not in (list, dict):
            yield prefix + name
        elif dataclasses.is_dataclass(hint):
            yield from _texts(hint, f"{prefix}{name}.")


def check_launcher(section: DictConfig) -> None:
    """Raise ConfigError for a launcher's unknown key, or a value of another type."""
    values = OmegaConf.to_container(section, resolve=True)
    schema = LAUNCHERS.get(str(values["_target_"]).rpartition(".")[2])
    known = schema and OmegaConf.structured(schema)
    for key, value in values.items() if schema else ():
        name = f"hydra.launcher.{key}"
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        least = 0 if key in ("max_num_timeout", "signal_delay_s", "verbose") else 1
        if key == "seeds_per_job" or (value is None and key in known):
            number, least = value is not None, 1
        elif key not in known:
            raise ConfigError(name, value, f"unknown key; {did_you_mean(key, known)}")
        else:
            try:
                known[key] = value
            except OmegaConfBaseException as error:
                raise ConfigError(name, value, str(error).splitlines()[0]) from error
        if number and (not isinstance(value, int) or value < least):
            raise ConfigError(name, value, f"must be a whole number from {least} on")
        if key.startswith("mem_per") and not re.fullmatch(
            r"\d+[KMGT]?B?", str(value or 1)
        ):
            raise ConfigError(name, value, "must be a size such as 2G or 800M")
    delay, limit = (values.get(key) or 0 for key in ("signal_delay_s", "timeout_min"))
    if limit and delay >= 60 * limit:
        why = f"leaves nothing of timeout_min={limit} minutes"
        raise ConfigError("hydra.launcher.signal_delay_s", delay, why)
