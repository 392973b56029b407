"""Old names of modules, which scripts and configs may still use."""

import importlib.util
import sys
from importlib.abc import Loader
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

_TABLE = Path(__file__).with_name("moved.txt").read_text("utf-8")
#: Old name → new name; modules below a package move with it.
MOVED = dict(line.split() for line in _TABLE.splitlines())


class _Moved(Loader):
    """Imports a module by its old name, as the same object as by its new one."""

    def __init__(self, new: ModuleSpec) -> None:
        self.new = new

    @classmethod
    def find_spec(cls, name: str, path: Any = None, target: Any = None) -> Any:
        for old, new in MOVED.items() if name.startswith("bcrl.") else ():
            if f"{name}.".startswith(f"{old}."):
                found = importlib.util.find_spec(new + name.removeprefix(old))
                package = found and found.submodule_search_locations is not None
                return found and ModuleSpec(name, cls(found), is_package=package)
        return None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return importlib.import_module(self.new.name)

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self.new  # its own; it was executed under its new name

    def get_code(self, name: str) -> Any:  # what `python -m` with the old name runs
        return self.new.loader.get_code(self.new.name)  # type: ignore


sys.meta_path.insert(0, _Moved)  # type: ignore
