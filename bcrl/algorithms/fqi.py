"""FQI's settings, and the stages they make: one a task slot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bcrl.composition import Composition, capped, placed
from bcrl.config import construct, one_of, per_task
from bcrl.envs import Env, is_finite
from bcrl.errors import ConfigError
from bcrl.identity import Plain
from bcrl.learners.fqi import FQI
from bcrl.q.regression import Regressor
from bcrl.q.regressors import regressor_class
from bcrl.stage import Stage
from bcrl.transfer import Boost, PolicyReuse, ResidualPolicy, Shape

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
    """One stage a task slot, with the scale's caps on its budget."""
    settings: Settings = construct("algorithm", Settings, section)
    _check_transfers(chosen)
    n, order = len(chosen.tasks), chosen.order
    one_of("algorithm.new_data", settings.new_data, ["stage", "task"])
    one_of("algorithm.dataset", settings.dataset, ["own", "shared"])
    one_of("algorithm.fit_randomness", settings.fit_randomness, ["fresh", "fixed"])
    regressor = _regressor(settings, chosen.tasks[-1])
    iterations = per_task("algorithm.iterations", settings.iterations, n, int, 1)
    episodes = per_task("algorithm.episodes", settings.episodes, n, int, 1)
    epsilon = per_task("algorithm.epsilon", settings.epsilon, n, float, 0, 1)
    if settings.dataset == "shared" and min(epsilon) < 1:
        why = "seeds can share data only if all are random: algorithm.epsilon must be 1"
        raise ConfigError("algorithm.dataset", "shared", why)
    made = []
    for slot, task in enumerate(order):
        again = slot > 0 and order[slot - 1] == task and settings.new_data == "task"
        if again and (epsilon[slot], episodes[slot]) != (epsilon[0], episodes[0]):
            why = "the task's data are kept, so epsilon and episodes must stay the same"
            raise ConfigError("algorithm.new_data", "task", why)
        learner = FQI(
            iterations=capped(iterations[slot], chosen.scale["max_iterations"]),
            episodes=capped(episodes[slot], chosen.scale["max_episodes"]),
            regressor=regressor,
            epsilon=epsilon[slot],
            new_data=not again,
            shared_data=settings.dataset == "shared",
            fixed_trees=settings.fit_randomness == "fixed",
        )
        env = chosen.tasks[task]
        made.append(Stage(slot + 1, task + 1, env, learner, chosen.transfers, 0))
    return placed(made)


def _check_transfers(chosen: Composition) -> None:
    """Raise ConfigError for what has no meaning in fitted iteration."""
    if isinstance(chosen.transfer, (PolicyReuse, ResidualPolicy)):
        why = "steers step by step, FQI learns from whole episodes; use algorithm=dqn"
        reuse = isinstance(chosen.transfer, PolicyReuse)
        name = "policy_reuse" if reuse else "residual_policy"
        raise ConfigError("transfer", name, why)
    if chosen.boost not in (None, Boost()):
        why = "is the released DQN's reading; the released FQI boosts as boosting=on"
        raise ConfigError("boosting", "released", why)
    if isinstance(chosen.transfer, Shape) and chosen.transfer != Shape():
        why = "is the released DQN's reading; FQI knows transfer=shaping"
        raise ConfigError("transfer", "shaping_released", why)


def _regressor(settings: Settings, target: Env) -> Regressor:
    values = dict(settings.regressor)
    cls = regressor_class(str(values.pop("name", None)))
    regressor = construct("algorithm.regressor", cls, values)
    if regressor.finite_only and not is_finite(target):
        why = f"needs finitely many states, which {target.name} has not"
        raise ConfigError("algorithm.regressor", settings.regressor["name"], why)
    return regressor
