"""FQI's settings, and the stages they make: one per task slot."""

import math
from dataclasses import dataclass
from typing import Literal

from bcrl.common.checks import construct
from bcrl.common.identity import Plain
from bcrl.config.algorithms import per_slot
from bcrl.config.rules import course
from bcrl.config.variant import Composition
from bcrl.envs import Env, is_simulated
from bcrl.learning.fqi import FQI
from bcrl.learning.stage import Stage
from bcrl.q.regressors.ours import regressor_class

FAMILY = "FQI"
LOCKSTEP = 4
_PER_SLOT = ("iterations", "episodes", "epsilon", "evaluate_every")
#: A step of E evaluated episodes takes as long as fitting 150 + 2 E rows (measured).
_STEP, _EPISODE = 150, 2
_SHARE = 0.2  # of a run's time that evaluations may take


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
    evaluate_every: int | None
    regressor: dict


def stages(section: Plain, chosen: Composition) -> tuple[Stage, ...]:
    """One stage per slot."""
    learners = []
    each = per_slot(section, _PER_SLOT, len(chosen.order))
    for values, env in zip(each, chosen.slots, strict=True):
        own: _Settings = construct("algorithm", _Settings, values)
        every = own.evaluate_every
        if every is None:
            every = interval(env, own.iterations, own.episodes)
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
                evaluate_every=every,
            )
        )
    return course(chosen, learners)


def interval(env: Env, iterations: int, episodes: int) -> int:
    """Iterations between two evaluations that take `_SHARE` of a stage's time at most.

    At least the last iteration is evaluated. Evaluated and collected episodes have the
    same horizon, so it cancels out.
    """
    evaluated = env.starts if is_simulated(env) else len(env.evaluation_states())
    rows = (_STEP + _EPISODE * evaluated) * (1 - _SHARE) / _SHARE
    return math.ceil(iterations / max(1, iterations * episodes // rows))
