"""Algorithms: from a YAML of the group `algorithm` to the stages of a run."""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType

from bcrl.common import plugins
from bcrl.errors import ConfigError, did_you_mean


def algorithm(name: str) -> ModuleType:
    """The module of this package called `name`; ConfigError if there is none.

    It has `FAMILY` (how its runs are measured: "FQI" or "DQN"), `LOCKSTEP` (how many
    seeds it likes to train together) and `stages(section, composition)`. Others are
    modules of the user's own, as BCRL_TRUST allows.
    """
    names = [module.name for module in pkgutil.iter_modules(__path__)]
    if isinstance(name, str) and plugins.is_foreign(name, names):
        for needed in ("FAMILY", "LOCKSTEP", "stages"):
            plugins.attribute("algorithm.name", name, f"{name}.{needed}")
        return plugins.module("algorithm.name", name, name)
    if name not in names:
        raise ConfigError("algorithm.name", name, did_you_mean(str(name), names))
    return importlib.import_module(f"{__name__}.{name}")
