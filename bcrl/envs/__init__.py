"""The tasks: one file per environment, each a frozen dataclass named `ENV`."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Sequence

from bcrl.common import plugins
from bcrl.envs import _protocol
from bcrl.envs._success import Success
from bcrl.envs.base import Env, FiniteEnv, is_finite, is_simulated, lanes_of
from bcrl.errors import BcrlError, ConfigError, did_you_mean

__all__ = [
    "Env",
    "FiniteEnv",
    "Success",
    "check_tasks",
    "env_class",
    "env_names",
    "is_finite",
    "is_simulated",
    "lanes_of",
]


#: Modules of this package that are no environments.
PARTS = ("base", "gym_api", "rendering", "tasks")


def env_names() -> list[str]:
    """Names of the environments that this package ships."""
    found = (module.name for module in pkgutil.iter_modules(__path__))
    return [name for name in found if name not in PARTS and name[0] != "_"]


def check_tasks(name: str, tasks: Sequence[Env]) -> None:
    """Raise ConfigError for tasks that no learner could do with.

    Pure environments of this package are tested, the user's own are tried.
    """
    target = tasks[-1]
    for number, task in enumerate(tasks, start=1):
        for what in ("state_dim", "n_actions"):
            here, there = getattr(task, what, None), getattr(target, what, None)
            if here != there:
                why = f"task {number} has {what} {here}, the target {there}; "
                why += "expected the same in all tasks"
                if is_simulated(target) and what == "state_dim":
                    why += ": a function env.observation makes them so"
                raise ConfigError("env.tasks", what, why)
    if is_simulated(target):
        target.check_tasks(tasks)
    elif name not in env_names():
        _protocol.check_tasks(name, tasks)


def env_class(name: str) -> type:
    """The environment class called `name`; BcrlError if there is none.

    Others are modules of the user's own, as BCRL_TRUST allows.
    """
    if plugins.is_foreign(name, env_names()):
        return plugins.component("env.name", name, f"{name}.ENV")
    if name not in env_names():
        raise BcrlError(f"env.name={name}: {did_you_mean(name, env_names())}")
    return importlib.import_module(f"bcrl.envs.{name}").ENV
