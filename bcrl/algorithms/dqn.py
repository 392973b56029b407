"""DQN's settings, and the stages they make, LSPI's pretraining among them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bcrl.composition import Composition, capped, placed
from bcrl.config import construct, one_of, per_task
from bcrl.envs import Env
from bcrl.errors import ConfigError, at_least
from bcrl.identity import Plain
from bcrl.learners.dqn import DQN
from bcrl.learners.lspi import LSPI
from bcrl.q.quadratic import FEATURES
from bcrl.stage import Stage
from bcrl.transfer import hands_on_a_policy, warm_start

FAMILY = "DQN"
LOCKSTEP = 20
LEARNERS = ("auto", "dqn", "lspi")


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
    """One stage a task slot; one in all where nothing would change between slots."""
    settings: Settings = construct("algorithm", Settings, section)
    _check(settings)
    warm = chosen.transfers == (warm_start,)
    slots = list(enumerate(chosen.order))
    alone = warm and chosen.target_only
    if alone:  # the networks, the task and the replay go on: no stage ends
        slots = slots[-1:]
    values = _per_task(settings, len(chosen.tasks))
    made = []
    for number, (slot, task) in enumerate(slots, start=1):
        env = chosen.tasks[task]
        own = {key: each[slot] for key, each in values.items()}
        kind = own.pop("learners")
        if kind == "auto":
            quadratic = getattr(env, "linear_quadratic", None) is not None
            kind = "lspi" if quadratic and not warm else "dqn"
        if kind == "lspi":
            learner = _lspi(settings, env, own, warm)
        else:
            if alone:
                own["steps"] = sum(values["steps"])
            own["steps"] = capped(own["steps"], chosen.scale["max_steps"])
            # Whoever starts without a policy fills the replay at random.
            knows = number > 1 and hands_on_a_policy(chosen.transfers)
            learner = DQN(
                **own,
                random_steps=0 if knows else settings.random_steps,
                learning_starts=settings.learning_starts,
                batch_size=settings.batch_size,
                replay_size=settings.replay_size,
                hidden=tuple(settings.hidden),
                learning_rate=float(settings.learning_rate),
            )
        made.append(Stage(number, task + 1, env, learner, chosen.transfers, 0))
    return placed(made)


def _per_task(settings: Settings, n: int) -> dict[str, list]:
    """The values that may differ between tasks, checked."""
    learners = settings.learners
    learners = learners if isinstance(learners, list) else [learners] * n
    if len(learners) != n:
        why = f"has {len(learners)} entries, but there are {n} tasks"
        raise ConfigError("algorithm.learners", learners, why)
    for name in learners:
        one_of("algorithm.learners", name, LEARNERS)
    bounds = {
        "steps": (int, 1),
        "epsilon": (float, 0, 1),
        "epsilon_start": (float, 0, 1),
        "anneal_steps": (int, 0),
        "target_update": (int, 1),
        "evaluate_every": (int, 1),
        "evaluation_episodes": (int, 1),
        "evaluation_epsilon": (float, 0, 1),
    }
    return {"learners": learners} | {
        key: per_task(f"algorithm.{key}", getattr(settings, key), n, *bound)
        for key, bound in bounds.items()
    }


def _check(settings: Settings) -> None:
    """Raise ConfigError for a value out of range, by itself or beside another."""
    at_least("algorithm.random_steps", settings.random_steps, 0)
    at_least("algorithm.learning_starts", settings.learning_starts, 0)
    at_least("algorithm.batch_size", settings.batch_size, 1)
    if settings.replay_size < settings.batch_size:
        why = f"holds less than a batch, algorithm.batch_size={settings.batch_size}"
        raise ConfigError("algorithm.replay_size", settings.replay_size, why)
    if settings.replay_size <= settings.learning_starts:
        why = (
            "never holds more than algorithm.learning_starts="
            f"{settings.learning_starts}, so nothing would be learned"
        )
        raise ConfigError("algorithm.replay_size", settings.replay_size, why)
    if settings.learning_rate <= 0:
        raise ConfigError(
            "algorithm.learning_rate", settings.learning_rate, "must be above 0"
        )
    _lspi_settings(settings)
    widths = settings.hidden
    if not widths or not all(type(w) is int and w >= 1 for w in widths):
        why = "must be a list of layer widths, each at least 1"
        raise ConfigError("algorithm.hidden", widths, why)


def _lspi(settings: Settings, env: Env, own: dict[str, Any], warm: bool) -> LSPI:
    """LSPI for a task that suits it; ConfigError says why not."""
    if getattr(env, "linear_quadratic", None) is None or not hasattr(env, "push"):
        why = (
            f"learns quadratic Q-functions of continuous actions, but {env} is no "
            "linear-quadratic task"
        )
        raise ConfigError("algorithm.learners", "lspi", why)
    if warm:
        why = "leaves no network to start DQN's from: boosting=on or a transfer needed"
        raise ConfigError("algorithm.learners", "lspi", why)
    chosen = _lspi_settings(settings)
    learner = LSPI(
        chosen.iterations,
        own["steps"],
        float(chosen.noise_std),
        chosen.features,
        chosen.drop_last,
        own["evaluation_episodes"],
    )
    learner.episodes(env)  # which says whether they are whole
    return learner


def _lspi_settings(settings: Settings) -> LSPISettings:
    """The section `lspi`, checked whether a stage needs it or not."""
    chosen = construct("algorithm.lspi", LSPISettings, settings.lspi)
    at_least("algorithm.lspi.iterations", chosen.iterations, 1)
    one_of("algorithm.lspi.features", chosen.features, FEATURES)
    if chosen.noise_std <= 0:
        why = "must be above 0: without noise LSTDQ sees one action a state"
        raise ConfigError("algorithm.lspi.noise_std", chosen.noise_std, why)
    return chosen
