"""The tasks: one file per environment, each a frozen dataclass named `ENV`."""

import importlib
from collections.abc import Sequence

from bcrl.common import plugins
from bcrl.common.checks import construct, one_of
from bcrl.common.identity import Plain
from bcrl.common.registration import REGISTERED
from bcrl.envs.base import Env, FiniteEnv, Success, is_finite, is_simulated, lanes_of
from bcrl.envs.checks import check_pure_tasks
from bcrl.errors import ConfigError

__all__ = ["Env", "FiniteEnv", "Success", "is_finite", "is_simulated", "lanes_of"]
__all__ += ["check_tasks", "env_class", "env_names", "tasks_of"]
#: Keys of a config's `env` section that are no constants of an environment.
_OTHERS = ("name", "tasks", "metrics", "paper_seeds")


def env_names() -> list[str]:
    """Names of the environments in this package: our tasks and `gymnasium`."""
    return sorted(["gymnasium", *(name for name, _ in REGISTERED.values())])


def check_tasks(name: str, tasks: Sequence[Env]) -> None:
    """Raise ConfigError for tasks that no learner can use, after random play."""
    for key in ("state_dim", "n_actions"):
        found = [getattr(task, key, None) for task in tasks]
        if found.count(found[0]) < len(found):
            why = f"is {found}, expected the same in all tasks"
            if key == "state_dim" and is_simulated(tasks[-1]):
                why += "; env.tasks.observation can make observations of one length"
            raise ConfigError("env.tasks", key, why)
    if is_simulated(target := tasks[-1]):
        target.check_tasks(tasks)
    elif name not in env_names():
        check_pure_tasks(name, tasks)


def env_class(name: str) -> type:
    """The class called `name`, here or in a trusted module; ConfigError for others."""
    if plugins.is_foreign(name, env_names()):
        return plugins.component("env.name", name, f"{name}.ENV")
    one_of("env.name", name, env_names())
    return importlib.import_module(f"bcrl.envs.{name}").ENV


def tasks_of(section: Plain) -> list[Env]:
    """An `env` section's tasks, the target last; ConfigError if it describes none."""
    if not isinstance(section, dict) or not isinstance(section.get("name"), str):
        raise ConfigError("env", section, "must have a name")
    cls = env_class(section["name"])
    constants = {k: v for k, v in section.items() if k not in _OTHERS}
    parameters = section.get("tasks")
    if not isinstance(parameters, dict) or not parameters:
        raise ConfigError("env.tasks", parameters, "must map a parameter to its values")
    varied = {k: v for k, v in parameters.items() if v is not None}
    lengths = {len(v) if isinstance(v, list) else 0 for v in varied.values()}
    if len(lengths) > 1 or 0 in lengths:
        why = "every parameter needs a list with one value per task, all equally long"
        raise ConfigError("env.tasks", varied, why)
    for name in varied:
        if section.get(name):  # {}, [] and null set nothing
            raise ConfigError(f"env.{name}", section[name], f"env.tasks.{name} decides")
    rows = zip(*varied.values(), strict=True) if varied else [()]
    own = (dict(zip(varied, values, strict=True)) for values in rows)
    return [construct("env", cls, constants | each) for each in own]
