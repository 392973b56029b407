"""The tasks that a config's `env` section describes, as environments."""

from __future__ import annotations

from bcrl.common.checks import construct
from bcrl.common.identity import Plain
from bcrl.envs import Env, env_class
from bcrl.errors import ConfigError

#: Keys of the section that are no constants of an environment.
_OTHERS = ("name", "tasks", "metrics", "paper_seeds")


def tasks_of(section: Plain) -> list[Env]:
    """The environment's tasks, easiest first, the target last.

    Raises ConfigError if the section describes no tasks.
    """
    if not isinstance(section, dict) or not isinstance(section.get("name"), str):
        raise ConfigError("env", section, "must have a name")
    cls = env_class(section["name"])
    constants = {k: v for k, v in section.items() if k not in _OTHERS}
    return [construct("env", cls, constants | own) for own in _parameters(section)]


def _parameters(section: dict) -> list[dict]:
    """The values that each task sets; a null leaves a parameter out."""
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
    return [dict(zip(varied, values, strict=True)) for values in rows]
