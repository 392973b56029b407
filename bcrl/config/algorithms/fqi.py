"""FQI's settings, and the stages they make: one per task slot."""

from dataclasses import dataclass
from typing import Literal

from bcrl.common.checks import construct
from bcrl.common.identity import Plain
from bcrl.config.algorithms import per_slot
from bcrl.config.rules import course
from bcrl.config.variant import Composition
from bcrl.learning.fqi import FQI
from bcrl.learning.stage import Stage
from bcrl.q.regressors.ours import regressor_class

FAMILY = "FQI"
LOCKSTEP = 4
_PER_SLOT = ("iterations", "episodes", "epsilon")


@dataclass(frozen=True)
class _Settings:
    """`conf/algorithm/fqi.yaml` in one slot."""

    name: str
    iterations: int
    episodes: int
    epsilon: float
    new_data: Literal["stage", "task"]
    dataset: Literal["own", "shared"]
    fit_randomness: Literal["fresh", "fixed"]
    regressor: dict


def stages(section: Plain, chosen: Composition) -> tuple[Stage, ...]:
    """One stage per slot."""
    learners = []
    for values in per_slot(section, _PER_SLOT, len(chosen.order)):
        own: _Settings = construct("algorithm", _Settings, values)
        arguments = dict(own.regressor)
        cls = regressor_class(str(arguments.pop("name", None)))
        learners.append(
            FQI(
                iterations=own.iterations,
                episodes=own.episodes,
                regressor=construct("algorithm.regressor", cls, arguments),
                epsilon=own.epsilon,
                new_data=own.new_data == "stage",
                shared_data=own.dataset == "shared",
                fixed_trees=own.fit_randomness == "fixed",
            )
        )
    return course(chosen, learners)
