"""Modules of the user's own that a config may name: BCRL_TRUST=my_package,my.module."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import os
from collections.abc import Collection
from pathlib import Path
from types import ModuleType
from typing import Any

from bcrl.errors import ConfigError

VARIABLE = "BCRL_TRUST"  # of the process's environment; no config can set it


def is_foreign(name: str, ours: Collection[str]) -> bool:
    """Whether `name` means a module of the user's; names of `ours` never do."""
    return name not in ours and ("." in name or is_trusted(name))


def is_trusted(name: str) -> bool:
    """Whether `name` is a module that BCRL_TRUST lists, or lies below one."""
    return any(f"{name}.".startswith(f"{entry}.") for entry in _listed())


def _listed() -> list[str]:
    """What BCRL_TRUST names."""
    entries = os.environ.get(VARIABLE, "").split(",")
    return [entry.strip() for entry in entries if entry.strip()]


def module(key: str, name: str, where: str, known: Collection[str] = ()) -> ModuleType:
    """The module `where`, imported; ConfigError if it can't be.

    It must be trusted, or of a package that is `known`.
    """
    if not all(part.isidentifier() for part in where.split(".")):
        raise ConfigError(key, name, "isn't the name of a module")
    if where.partition(".")[0] not in known and not is_trusted(where):
        why = "isn't of this package; if you trust its code, set the environment "
        raise ConfigError(key, name, f"{why}variable {VARIABLE}={where.split('.')[0]}")
    try:
        return importlib.import_module(where)
    except Exception as error:  # whatever its code does
        why = f"can't be imported: {type(error).__name__}: {error}"
        raise ConfigError(key, name, why) from error


def sources() -> list[Path]:
    """The Python files of what is trusted and can be found."""
    found: list[Path] = []
    for entry in _listed():
        try:
            spec = importlib.util.find_spec(entry)
        except Exception:  # of a package above it; who imports it will say so
            continue
        for folder in (spec and spec.submodule_search_locations) or ():
            found += Path(folder).rglob("*.py")
        if spec and spec.origin and not spec.submodule_search_locations:
            found.append(Path(spec.origin))
    return sorted(path for path in found if path.is_file())  # not "built-in"


def attribute(key: str, name: str, dotted: str, known: Collection[str] = ()) -> Any:
    """What the module that `dotted` begins with calls by its last part."""
    where, _, last = dotted.rpartition(".")
    found = getattr(module(key, name, where, known), last, None)
    if found is None:
        raise ConfigError(key, name, f"the module {where} has no {last}")
    return found


def component(key: str, name: str, dotted: str) -> type:
    """The dataclass at `dotted`, as `attribute` finds it."""
    found = attribute(key, name, dotted)
    if not (isinstance(found, type) and dataclasses.is_dataclass(found)):
        raise ConfigError(key, name, f"{dotted} must be a frozen dataclass")
    return found
