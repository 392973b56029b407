"""Algorithms: from a YAML of the group `algorithm` to the stages of a run."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

from bcrl.envs import Env
from bcrl.errors import ConfigError, did_you_mean
from bcrl.transfer import (
    Boost,
    PolicyReuse,
    ResidualPolicy,
    Shape,
    Transfer,
    warm_start,
)

Plain = dict[str, Any]  # a resolved config: dicts, lists and scalars


@dataclass(frozen=True)
class Composition:
    """What the groups besides `algorithm` choose, as an algorithm sees it."""

    tasks: tuple[Env, ...]  # easiest first, the target last
    order: tuple[int, ...]  # the task of each slot
    boost: Boost | None
    transfer: Shape | PolicyReuse | ResidualPolicy | None
    scale: Plain

    @property
    def transfers(self) -> tuple[Transfer, ...]:
        """What happens between two stages: a warm start unless something else does."""
        chosen = (self.boost, self.transfer)
        return tuple(t for t in chosen if t is not None) or (warm_start,)

    @property
    def target_only(self) -> bool:
        """Whether every slot has the same task."""
        return len(set(self.order)) == 1


def algorithm(name: str) -> ModuleType:
    """The module of this package called `name`; ConfigError if there is none.

    It has `FAMILY` (how its runs are measured: "FQI" or "DQN"), `LOCKSTEP` (how many
    seeds it likes to train together) and `stages(section, composition)`.
    """
    names = [module.name for module in pkgutil.iter_modules(__path__)]
    if name not in names:
        raise ConfigError("algorithm.name", name, did_you_mean(str(name), names))
    return importlib.import_module(f"{__name__}.{name}")


def capped(value: int, cap: int | None) -> int:
    """A budget under the scale's cap."""
    return value if cap is None else min(value, cap)


def placed(stages: Sequence[Any]) -> tuple[Any, ...]:
    """Stages whose `before` counts what the ones before them take."""
    done, out = 0, []
    for stage in stages:
        out.append(replace(stage, before=done))
        done += stage.learner.length
    return tuple(out)
