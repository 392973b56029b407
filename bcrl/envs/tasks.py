"""The tasks that a config's `env` section describes, as environments."""

from __future__ import annotations

from bcrl.common.checks import construct
from bcrl.common.identity import Plain
from bcrl.envs import Env, env_class
from bcrl.errors import ConfigError


def tasks_of(section: Plain) -> list[Env]:
    """The environment's tasks, easiest first, the target last.

    Raises ConfigError for whatever describes no task.
    """
    if not isinstance(section, dict) or not isinstance(section.get("name"), str):
        raise ConfigError("env", section, "must have a name")
    cls = env_class(section["name"])
    return [
        construct("env", cls, _constants(section) | parameters)
        for parameters in _parameters(section)
    ]


def _constants(section: Plain) -> Plain:
    """What an environment is constructed with in every task."""
    others = ("name", "tasks", "metrics", "paper_seeds")
    return {k: v for k, v in section.items() if k not in others}


def _parameters(section: Plain) -> list[Plain]:
    """What differs between tasks, for each task; null leaves a parameter out."""
    parameters = section.get("tasks")
    if not isinstance(parameters, dict) or not parameters:
        raise ConfigError("env.tasks", parameters, "must map a parameter to its values")
    varied = {k: v for k, v in parameters.items() if v is not None}
    if not varied:
        return [{}]
    lengths = {k: len(v) if isinstance(v, list) else 0 for k, v in varied.items()}
    if len(set(lengths.values())) != 1 or 0 in lengths.values():
        why = "every parameter needs a list with one value a task, all of one length"
        raise ConfigError("env.tasks", varied, why)
    for name in varied:
        if section.get(name):  # {}, [] and null say nothing
            raise ConfigError(f"env.{name}", section[name], f"env.tasks.{name} decides")
    return [
        dict(zip(varied, values, strict=True))
        for values in zip(*varied.values(), strict=True)
    ]
