"""The configuration's schema, and checks that name key, value and what is allowed."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, get_type_hints

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf

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
    if type(value) is int:
        return {"count": value} if key == "seeds" else {"count": None, "only": [value]}
    if isinstance(value, list):
        return {"count": None, "only": list(value)}
    if isinstance(value, Mapping) and key == "seeds" and not {"count", "only"} <= {*value}:
        return ({"count": None} if value.get("only") else {}) | dict(value)
    why = "how many (seeds=5), just these (seeds=[3,7,11]), or one (seed=3)"
    raise ConfigError(key, value, why)


def seeds_of(config: Any) -> None:
    """Write `seeds: 5`, `seeds: [3, 7]` and `seed: 3` of a file as the section's keys."""
    for key in ("seed", "seeds"):
        if isinstance(config, DictConfig) and config.get(key) is not None:
            value = OmegaConf.to_container(config, resolve=False).pop(key)
            del config[key]
            config["seeds"] = section_of_seeds(key, value)


def one_of(key: str, value: object, allowed: Sequence[str]) -> None:
    """Raise ConfigError unless `value` is one of `allowed`."""
    if value not in allowed:
        raise ConfigError(key, value, did_you_mean(str(value), allowed))


def construct(section: str, cls: type, values: Mapping[str, Any]) -> Any:
    """`cls(**values)` with every key known and every value of its annotated type.

    Raises ConfigError naming `section.key` otherwise.
    """
    hints = {f.name: get_type_hints(cls)[f.name] for f in dataclasses.fields(cls)}
    for key, value in values.items():
        if key not in hints:
            raise ConfigError(
                f"{section}.{key}", value, f"unknown key; {did_you_mean(key, hints)}"
            )
        if not _fits(value, hints[key]):
            kind = getattr(hints[key], "__name__", hints[key])
            raise ConfigError(f"{section}.{key}", value, f"must be of type {kind}")
    missing = [
        f.name
        for f in dataclasses.fields(cls)
        if f.name not in values
        and f.default is dataclasses.MISSING
        and f.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise ConfigError(f"{section}.{missing[0]}", None, "is required")
    return cls(**values)


def _fits(value: object, hint: Any) -> bool:
    if hint is Any:
        return True
    if hint is float:
        return type(value) in (int, float) and math.isfinite(value)
    return type(value) is hint


def per_task(
    key: str, value: Any, n_tasks: int, kind: type, least: float, most: float = math.inf
) -> list:
    """A budget's value for each task, from one value or a list of `n_tasks`."""
    values = value if isinstance(value, list) else [value] * n_tasks
    if len(values) != n_tasks:
        raise ConfigError(
            key, value, f"has {len(values)} entries, but there are {n_tasks} tasks"
        )
    bounds = f"at least {least:g}" if most == math.inf else f"in [{least:g}, {most:g}]"
    for entry in values:
        if not _fits(entry, kind) or not least <= entry <= most:
            noun = "integer" if kind is int else "number"
            raise ConfigError(key, value, f"every entry must be one {noun} {bounds}")
    return [kind(entry) for entry in values]
