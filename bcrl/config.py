"""The configuration's schema, and checks that name key, value and what is allowed."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, get_type_hints

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

from bcrl.errors import ConfigError, did_you_mean


@dataclass
class Seeds:
    first: int = 0
    count: int = 3
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


def one_of(key: str, value: object, allowed: Sequence[str]) -> None:
    """Raise ConfigError unless `value` is one of `allowed`."""
    if value not in allowed:
        raise ConfigError(key, value, did_you_mean(str(value), allowed))


def construct(section: str, cls: type, values: Mapping[str, Any]) -> Any:
    """`cls(**values)` with every key known and every value of its annotated type.

    Raises ConfigError naming `section.key` otherwise.
    """
    kinds = get_type_hints(cls)
    hints = {f.name: kinds[f.name] for f in dataclasses.fields(cls)}
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
