"""FQI's settings, and the stages they make: one a task slot."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from bcrl.common.checks import construct, one_of, per_task
from bcrl.common.identity import Plain
from bcrl.config.rules import BOUNDS, capped, course
from bcrl.config.variant import Composition
from bcrl.learning.fqi import FQI
from bcrl.learning.stage import Stage
from bcrl.q.regressors.base import Regressor
from bcrl.q.regressors.ours import regressor_class

FAMILY = "FQI"
LOCKSTEP = 4


@dataclass(frozen=True)
class Settings:
    """`conf/algorithm/fqi.yaml`; a budget is one value or a list with one a task."""

    name: str
    iterations: Any
    episodes: Any
    epsilon: Any
    new_data: str
    dataset: str
    fit_randomness: str
    regressor: dict


def stages(section: Plain, chosen: Composition) -> tuple[Stage, ...]:
    """One stage per slot, with the scale's caps on its budget."""
    settings: Settings = construct("algorithm", Settings, section)
    one_of("algorithm.new_data", settings.new_data, ["stage", "task"])
    one_of("algorithm.dataset", settings.dataset, ["own", "shared"])
    one_of("algorithm.fit_randomness", settings.fit_randomness, ["fresh", "fixed"])
    budgets = [
        per_task(f"algorithm.{k}", getattr(settings, k), len(chosen.order), *BOUNDS[k])
        for k in ("iterations", "episodes", "epsilon")
    ]
    regressor = _regressor(settings)
    learners = [
        FQI(
            iterations=iterations,
            episodes=episodes,
            regressor=regressor,
            epsilon=epsilon,
            new_data=settings.new_data == "stage",
            shared_data=settings.dataset == "shared",
            fixed_trees=settings.fit_randomness == "fixed",
        )
        for iterations, episodes, epsilon in zip(*budgets, strict=True)
    ]
    name = {"algorithm.regressor": settings.regressor["name"]}
    made = course(replace(chosen, written={**chosen.written, **name}), learners)
    caps = {key: chosen.scale[f"max_{key}"] for key in ("iterations", "episodes")}
    return capped(made, FQI, **caps)


def _regressor(settings: Settings) -> Regressor:
    values = dict(settings.regressor)
    cls = regressor_class(str(values.pop("name", None)))
    return construct("algorithm.regressor", cls, values)
