"""Old names of modules, which scripts and configs may still use."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from importlib.abc import Loader
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

_LEARNING = ("bellman", "curriculum", "policies", "replay", "rollout", "stage")
#: Old name → new name; modules below a package move with it.
MOVED = {f"bcrl.{name}": f"bcrl.learning.{name}" for name in (*_LEARNING, "transfer")}
MOVED |= {
    "bcrl.algorithms": "bcrl.config.algorithms",
    "bcrl.data": "bcrl.learning.dataset",
    "bcrl.drawing": "bcrl.envs.rendering",
    "bcrl.gym": "bcrl.envs.gym_api",
    "bcrl.learners": "bcrl.learning",
    "bcrl.loggers": "bcrl.results.loggers",
    "bcrl.oracle": "bcrl.evaluation.oracle",
    "bcrl.pack": "bcrl.common.serialization",
    "bcrl.probes": "bcrl.evaluation.metrics",
    "bcrl.q.estimator": "bcrl.q.forest.estimator",
    "bcrl.q.mlp": "bcrl.q.networks.mlp",
    "bcrl.q.regression": "bcrl.q.regressors.base",
    "bcrl.q.scikit": "bcrl.q.regressors.scikit",
    "bcrl.report.verify": "bcrl.results.verify",
    "bcrl.streams": "bcrl.common.seeding",
}


class _Moved(Loader):
    """Imports a module by its old name, as the same object as by its new one."""

    def __init__(self, new: str) -> None:
        self.new = new

    @classmethod
    def find_spec(cls, name: str, path: Any = None, target: Any = None) -> Any:
        """The spec of a module that has moved; None for all others."""
        for old, new in MOVED.items() if name.startswith("bcrl.") else ():
            if f"{name}.".startswith(f"{old}."):
                loader = cls(new + name.removeprefix(old))
                found = importlib.util.find_spec(loader.new)
                package = found is not None and found.submodule_search_locations
                return found and ModuleSpec(name, loader, is_package=bool(package))
        return None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """The module by its new name, which keeps its own spec."""
        module = importlib.import_module(self.new)
        self.spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Nothing: the module was executed under its new name."""
        module.__spec__ = self.spec

    def get_code(self, name: str) -> Any:
        """The code that `python -m` with the old name runs."""
        spec: Any = importlib.util.find_spec(self.new)
        return spec.loader.get_code(self.new)


def install() -> None:
    """Let imports find the old names."""
    if _Moved not in sys.meta_path:
        sys.meta_path.insert(0, _Moved)
