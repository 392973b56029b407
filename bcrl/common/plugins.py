"""Modules of the user's own: which ones a config may name, and their sources.

A config alone names none. Names that were typed are the user's own, as are names in
a folder that was passed by --config-dir, and modules that BCRL_TRUST=a,b.c lists.
"""

import dataclasses
import hashlib
import importlib.util
import os
import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from bcrl.common.identity import flat
from bcrl.errors import ConfigError

VARIABLE = "BCRL_TRUST"  # of this process and the workers that it starts
#: The keys whose values may name code.
NAMING = ("env.name", "env.id", "env.observation", "env.tasks.observation")
NAMING += ("env.wrappers", "env.tasks.wrappers", "algorithm.name")
NAMING += ("algorithm.regressor.name", "curriculum.name", "transfer.name")
NAMING += ("logger.name", "start.observation")


def named_code(config: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The keys of a config that name code of the user's, each with the name."""
    values = flat(dict(config))
    for key in NAMING:
        for one in _single(values.get(key)):
            name = one.get("name") if isinstance(one, dict) else one
            end = ":" if key == "env.id" else "."
            if isinstance(name, str) and (end in name or is_trusted(name)):
                yield key, name


def _single(value: Any) -> list[Any]:
    """The values in lists of lists, or the value that is no list."""
    if not isinstance(value, list):
        return [value]
    return [one for part in value for one in _single(part)]


def trust(name: str) -> None:
    """Let configs name the package that `name` begins with, here and in workers."""
    package = re.split("[.:]", name)[0]
    if not is_trusted(package):
        os.environ[VARIABLE] = f"{os.environ.get(VARIABLE, '')},{package}".lstrip(",")


def is_foreign(name: str, ours: Collection[str]) -> bool:
    """Whether `name` means a module of the user's; names of `ours` never do."""
    return name not in ours and ("." in name or is_trusted(name))


def is_trusted(name: str) -> bool:
    """Whether `name` is a trusted module, or lies below one."""
    listed = os.environ.get(VARIABLE, "").replace(",", " ").split()
    return any(f"{name}.".startswith(f"{entry}.") for entry in listed)


def module(key: str, name: str, where: str, known: Collection[str] = ()) -> ModuleType:
    """The module `where`, trusted or `known`, imported; ConfigError if it can't be."""
    if not all(part.isidentifier() for part in where.split(".")):
        raise ConfigError(key, name, "isn't the name of a module")
    if where.partition(".")[0] not in known and not is_trusted(where):
        why = "a config alone can't name code: type it, or pass its --config-dir; "
        why += "in a script, import the module"
        raise ConfigError(key, name, why)
    try:
        return importlib.import_module(where)
    except Exception as error:  # whatever its code does
        why = f"can't be imported: {type(error).__name__}: {error}"
        if isinstance(error, ModuleNotFoundError) and error.name == where:
            why += "; put the folder that holds it into PYTHONPATH"
        raise ConfigError(key, name, why) from error


def fingerprint(config: Mapping[str, Any]) -> str:
    """A digest of the sources of the user's packages that a config names, or ""."""
    packages = {re.split("[.:]", name)[0] for _, name in named_code(config)} - {"bcrl"}
    digest = hashlib.sha256()
    for package in sorted(packages):
        if spec := importlib.util.find_spec(package):
            for place in spec.submodule_search_locations or [str(spec.origin)]:
                for path in sorted([Path(place), *Path(place).rglob("*.py")]):
                    digest.update(path.read_bytes() if path.is_file() else b"")
    return digest.hexdigest() if packages else ""


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
