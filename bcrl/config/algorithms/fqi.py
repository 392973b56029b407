"""FQI's settings, and the stages they make: one per task slot."""

import math
from dataclasses import dataclass
from typing import Any, Literal

from bcrl.common.checks import construct
from bcrl.common.identity import Plain
from bcrl.config.algorithms import per_slot
from bcrl.config.rules import course
from bcrl.config.variant import Composition
from bcrl.envs import Env, is_simulated
from bcrl.errors import ConfigError
from bcrl.learning.fqi import FQI
from bcrl.learning.logged_files import content_sha256, locate
from bcrl.learning.stage import Stage
from bcrl.learning.transitions import LoggedFile, transitions_of
from bcrl.q.regressors.ours import regressor_class

FAMILY = "FQI"
COLLECTED = ("own", "shared")  # what `dataset` may be besides logged data
LOCKSTEP = 4
_PER_SLOT = (
    *("iterations", "episodes", "epsilon", "evaluate_every"),
    *("dataset", "dataset_sha256"),
)
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
    dataset: str  # one of COLLECTED, or logged data
    fit_randomness: Literal["fresh", "fixed"]
    evaluate_every: int | None
    regressor: dict
    dataset_sha256: str = ""  # of logged data


def stages(section: Plain, chosen: Composition) -> tuple[Stage, ...]:
    """One stage per slot."""
    learners = []
    if "dataset" not in section and (known := section.get("dataset_sha256")):
        section = section | {"dataset": known}  # a recorded run's data, not read again
    each = per_slot(section, _PER_SLOT, len(chosen.order))
    for values, task in zip(each, chosen.order, strict=True):
        own: _Settings = construct("algorithm", _Settings, values)
        env, data, episodes = chosen.tasks[task], None, own.episodes
        if own.dataset not in COLLECTED:
            data = LoggedFile(own.dataset, own.dataset_sha256)
            if data.is_named:
                rows = len(transitions_of(data, task + 1, env).reward)
                episodes = math.ceil(rows / env.horizon)  # as many, for what they cost
        every = own.evaluate_every
        if every is None:
            every = interval(env, own.iterations, episodes)
        arguments = dict(own.regressor)
        cls = regressor_class(str(arguments.pop("name", None)))
        learners.append(
            FQI(
                iterations=own.iterations,
                episodes=episodes,
                regressor=construct("algorithm.regressor", cls, arguments),
                epsilon=own.epsilon,
                new_data=own.new_data == "stage",
                shared_data=own.dataset == "shared",
                fixed_trees=own.fit_randomness == "fixed",
                evaluate_every=every,
                dataset=data,
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


def logged_identity(section: Plain) -> Plain:
    """`dataset_sha256` of a section with logged data: the content, wherever it lies."""
    given: Any = section.get("dataset")
    names = given if isinstance(given, list) else [given]
    if not all(isinstance(x, str) for x in names) or {*names} <= {*COLLECTED}:
        return {}
    found = [x if x in COLLECTED else content_sha256(locate(x)) for x in names]
    here = found if isinstance(given, list) else found[0]
    if section.get("dataset_sha256", here) != here:
        why = f"{given} has {here}: it was changed; leave the key out to accept this"
        raise ConfigError("algorithm.dataset_sha256", section["dataset_sha256"], why)
    return {"dataset_sha256": here}
