"""DQN's settings, and the stages they make, LSPI's pretraining among them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bcrl.common.checks import construct, one_of, per_task
from bcrl.common.identity import Plain
from bcrl.config.rules import BOUNDS, capped, course
from bcrl.config.variant import Composition
from bcrl.errors import ConfigError, at_least
from bcrl.learning.dqn import DQN
from bcrl.learning.lspi import LSPI
from bcrl.learning.stage import Learner, Stage
from bcrl.learning.transfer import warm_start
from bcrl.q.quadratic import FEATURES

FAMILY = "DQN"
LOCKSTEP = 20
LEARNERS = ("auto", "dqn", "lspi")
#: Settings that may differ between the slots, besides `learners`.
PER_TASK = (
    *("steps", "epsilon", "epsilon_start", "anneal_steps", "target_update"),
    *("evaluate_every", "evaluation_episodes", "evaluation_epsilon"),
)


@dataclass(frozen=True)
class LSPISettings:
    """The section `lspi`."""

    iterations: int
    noise_std: float
    features: str
    drop_last: bool


@dataclass(frozen=True)
class Settings:
    """`conf/algorithm/dqn.yaml`; where Any, one value or a list with one a task."""

    name: str
    learners: Any
    steps: Any
    random_steps: int
    learning_starts: int
    epsilon: Any
    epsilon_start: Any
    anneal_steps: Any
    target_update: Any
    batch_size: int
    replay_size: int
    hidden: list
    learning_rate: float
    evaluate_every: Any
    evaluation_episodes: Any
    evaluation_epsilon: Any
    lspi: dict


def stages(section: Plain, chosen: Composition) -> tuple[Stage, ...]:
    """The course that DQN makes of the slots, LSPI in the first where it can."""
    settings: Settings = construct("algorithm", Settings, section)
    lspi = _lspi_settings(settings)
    values = _per_task(settings, len(chosen.order))
    learners: list[Learner] = []
    for slot, env in enumerate(chosen.slots):
        own = {key: each[slot] for key, each in values.items()}
        kind = own.pop("learners")
        if kind == "auto":
            quadratic = getattr(env, "linear_quadratic", None) is not None
            first = slot == 0 and chosen.transfers != (warm_start,)
            kind = "lspi" if quadratic and first else "dqn"
        if kind == "lspi":
            learners.append(
                LSPI(
                    lspi.iterations,
                    own["steps"],
                    float(lspi.noise_std),
                    lspi.features,
                    lspi.drop_last,
                    own["evaluation_episodes"],
                )
            )
        else:
            learners.append(
                DQN(
                    **own,
                    random_steps=settings.random_steps,
                    learning_starts=settings.learning_starts,
                    batch_size=settings.batch_size,
                    replay_size=settings.replay_size,
                    hidden=tuple(settings.hidden),
                    learning_rate=float(settings.learning_rate),
                )
            )
    return capped(course(chosen, learners), DQN, steps=chosen.scale["max_steps"])


def _per_task(settings: Settings, n: int) -> dict[str, list]:
    """The values that may differ between tasks, checked."""
    learners = settings.learners
    learners = learners if isinstance(learners, list) else [learners] * n
    if len(learners) != n:
        why = f"has {len(learners)} entries, but there are {n} tasks"
        raise ConfigError("algorithm.learners", learners, why)
    for name in learners:
        one_of("algorithm.learners", name, LEARNERS)
    return {"learners": learners} | {
        key: per_task(f"algorithm.{key}", getattr(settings, key), n, *BOUNDS[key])
        for key in PER_TASK
    }


def _lspi_settings(settings: Settings) -> LSPISettings:
    """The section `lspi`, checked whether a stage needs it or not."""
    chosen = construct("algorithm.lspi", LSPISettings, settings.lspi)
    at_least("algorithm.lspi.iterations", chosen.iterations, 1)
    one_of("algorithm.lspi.features", chosen.features, FEATURES)
    if chosen.noise_std <= 0:
        why = "must be above 0: without noise LSTDQ sees one action per state"
        raise ConfigError("algorithm.lspi.noise_std", chosen.noise_std, why)
    return chosen
