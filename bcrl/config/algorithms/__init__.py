"""Algorithms: from a YAML of the group `algorithm` to the stages of a run."""

import importlib
import pkgutil
from collections.abc import Collection
from types import ModuleType
from typing import Any

from bcrl.common import plugins
from bcrl.common.checks import one_of
from bcrl.common.identity import Plain
from bcrl.errors import ConfigError


def algorithm(name: str) -> ModuleType:
    """The module of this package called `name`, or a trusted one of the user's.

    It has `FAMILY` (how its runs are measured: "FQI" or "DQN"), `LOCKSTEP` (how many
    seeds it likes to train together) and `stages(section, composition)`. Raises
    ConfigError for an unknown name.
    """
    names = [module.name for module in pkgutil.iter_modules(__path__)]
    if plugins.is_foreign(name, names):
        for needed in ("FAMILY", "LOCKSTEP", "stages"):
            plugins.attribute("algorithm.name", name, f"{name}.{needed}")
        return plugins.module("algorithm.name", name, name)
    one_of("algorithm.name", name, names)
    return importlib.import_module(f"{__name__}.{name}")


def per_slot(section: Plain, keys: Collection[str], n: int) -> list[dict[str, Any]]:
    """A section's values in each of n slots; those of `keys` may be lists, n long."""
    lists = {k: v for k, v in section.items() if k in keys and isinstance(v, list)}
    for key, values in lists.items():
        if len(values) != n:
            why = f"has {len(values)} entries, but there are {n} tasks"
            raise ConfigError(f"algorithm.{key}", values, why)
    return [section | {k: v[slot] for k, v in lists.items()} for slot in range(n)]
