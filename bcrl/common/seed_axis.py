"""One seed's part of an object of several seeds, and an object of several parts.

A field of a storable dataclass that has an entry per seed says on which axis.
"""

import dataclasses
from collections.abc import Sequence
from itertools import chain
from typing import Any, Literal

import numpy as np

from bcrl.common.serialization import is_derived, is_storable


def seeds_on(axis: Literal[0, 1]) -> dict[str, int]:
    """Metadata of a field with one entry per seed on an axis of it."""
    return {"seeds": axis}


def of_seed(thing: Any, s: int, made: dict[int, Any] | None = None) -> Any:
    """The part of the seed with index s; an object that occurs twice stays one."""
    made, kind = {} if made is None else made, type(thing)
    if id(thing) not in made:
        made[id(thing)] = thing  # settings and plain values are shared by all seeds
        if kind in (list, tuple):
            made[id(thing)] = kind([of_seed(part, s, made) for part in thing])
        elif is_storable(kind):
            parts = {}
            for name, axis in _fields(kind):
                value = getattr(thing, name)
                if axis is None or value is None:
                    parts[name] = of_seed(value, s, made)
                else:
                    own = slice(s, s + 1)
                    parts[name] = value[:, own] if axis else value[own]
            made[id(thing)] = kind(**parts)
    return made[id(thing)]


def joined(parts: Sequence[Any], made: dict[tuple[int, ...], Any] | None = None) -> Any:
    """The object of several seeds whose parts these are, in the order of the seeds."""
    made, first = {} if made is None else made, parts[0]
    key, kind = tuple(map(id, parts)), type(parts[0])
    if key not in made:
        made[key] = first
        if kind in (list, tuple):
            made[key] = kind([joined(x, made) for x in zip(*parts, strict=True)])
        elif is_storable(kind):
            fields = {}
            for name, axis in _fields(kind):
                values = [getattr(part, name) for part in parts]
                whole = axis is None or values[0] is None
                fields[name] = joined(values, made) if whole else _along(values, axis)
            made[key] = kind(**fields)
    return made[key]


def _fields(kind: type) -> list[tuple[str, int | None]]:
    """The stored fields of a dataclass, and on which axis of them the seeds are."""
    fields = [f for f in dataclasses.fields(kind) if not is_derived(f)]
    return [(f.name, f.metadata.get("seeds")) for f in fields]


def _along(values: Sequence[Any], axis: int) -> Any:
    if isinstance(values[0], np.ndarray):
        return np.concatenate(values, axis)
    if isinstance(values[0], (list, tuple)):
        return type(values[0])(chain.from_iterable(values))
    import torch  # FQI does not need it

    return torch.cat(list(values), axis)
