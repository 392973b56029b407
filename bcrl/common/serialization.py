"""Objects as JSON and arrays, and back: what checkpoints are made of.

Only plain values, arrays, tensors and classes marked `storable` can be packed, and only
these come back: reading a file runs none of its content.
"""

from __future__ import annotations

import dataclasses
import json
import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from bcrl.errors import BcrlError

#: Metadata of a dataclass's field that isn't stored: it follows from the others.
DERIVED = {"derived": True}
_STORABLE: dict[str, type] = {}
_PLAIN = (type(None), bool, int, float, str)


def storable(cls: type) -> type:
    """Mark a dataclass as one whose instances are packed field by field."""
    _STORABLE[_name(cls)] = cls
    return cls


def _name(cls: type) -> str:
    """What a class is called in a file: a user's `Sum` is another than ours."""
    return f"{cls.__module__}.{cls.__qualname__}"


def write(file: BinaryIO, about: dict, content: Any, given: Sequence[Any]) -> None:
    """Pack `content` into an NPZ, with a JSON document `about` it.

    Objects of `given` are not stored but named by their place in it. What occurs twice
    is stored once and comes back as one object. TypeError for what can't be packed.
    """
    packer = _Packer(given)
    structure = packer.pack(content)
    # In one piece: an NPZ's every array costs a fraction of a millisecond.
    data = np.concatenate([np.empty(0, np.uint8), *packer.bytes])
    np.savez(file, about=_text(about), structure=_text(structure), data=data)


def read_about(path: Path) -> dict:
    """The document about an NPZ's content; BcrlError if the file is not such a one."""
    with _opened(path) as stored:
        about = _json(stored["about"])
        if not isinstance(about, dict):
            raise ValueError("its description is no object")
        return about


def read(path: Path, given: Sequence[Any], device: str = "cpu") -> Any:
    """What `write` packed, tensors on `device`; BcrlError if it can't be read."""
    with _opened(path) as stored:
        unpacker = _Unpacker(stored["data"], given, device)
        return unpacker.unpack(_json(stored["structure"]))


class _opened:
    """An open NPZ; everything that may be wrong with it becomes one error."""

    def __init__(self, path: Path) -> None:
        self.path, self.stored = path, None

    def __enter__(self) -> Any:
        try:
            self.stored = np.load(self.path, allow_pickle=False)
            if not isinstance(self.stored, np.lib.npyio.NpzFile):
                raise ValueError("it is no NPZ")
            return self.stored
        except Exception as error:
            self.__exit__(type(error), error, None)
            raise

    def __exit__(self, kind: object, error: BaseException | None, _: object) -> None:
        if hasattr(self.stored, "close"):
            self.stored.close()
        broken = (ValueError, TypeError, LookupError, OSError, EOFError, MemoryError)
        if isinstance(error, (*broken, zipfile.BadZipFile, NotImplementedError)):
            raise BcrlError(f"{self.path} can't be read ({error})") from error


class _Packer:
    def __init__(self, given: Sequence[Any]) -> None:
        self.bytes: list[NDArray[np.uint8]] = []
        self._length = 0
        self._kept: list[Any] = []  # so that no number of `_seen` is used anew
        self._seen: dict[int, list] = {
            id(thing): ["given", place]
            for place, thing in enumerate(given)
            if not isinstance(thing, _PLAIN)
        }

    def pack(self, thing: Any) -> Any:
        if isinstance(thing, np.generic):
            thing = thing.item()
        if type(thing) in _PLAIN:
            return thing
        if id(thing) in self._seen:
            return self._seen[id(thing)]
        packed = self._parts(thing)
        self._seen[id(thing)] = ["same", len(self._kept)]
        self._kept.append(thing)
        return packed

    def _parts(self, thing: Any) -> list:
        kind, name = type(thing), type(thing).__name__
        if kind is np.ndarray and not thing.dtype.hasobject:
            return self._array("array", thing)
        if name == "Tensor" and kind.__module__.startswith("torch"):
            return self._array("tensor", thing.detach().cpu().numpy())
        if kind in (list, tuple):
            return [name, [self.pack(each) for each in thing]]
        if kind is dict:
            return [name, [[self.pack(k), self.pack(v)] for k, v in thing.items()]]
        if _STORABLE.get(_name(kind)) is kind:
            fields = {f.name: self.pack(getattr(thing, f.name)) for f in _fields(kind)}
            return ["object", _name(kind), fields]
        raise TypeError(f"{_name(kind)} is not storable")

    def _array(self, kind: str, array: NDArray) -> list:
        order = (
            "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
        )
        flat = np.ascontiguousarray(array.reshape(-1, order=order))
        self.bytes.append(flat.view(np.uint8))
        at, self._length = self._length, self._length + array.nbytes
        return [kind, [at, array.dtype.str, list(array.shape), order]]


class _Unpacker:
    def __init__(
        self, data: NDArray[np.uint8], given: Sequence[Any], device: str
    ) -> None:
        self.data, self.given, self.device = data, given, device
        self._made: list[Any] = []

    def unpack(self, packed: Any) -> Any:
        if not isinstance(packed, list):
            if not isinstance(packed, _PLAIN):
                raise ValueError("its structure holds something unknown")
            return packed
        kind, *rest = packed
        if kind == "given":
            return self.given[rest[0]]
        if kind == "same":
            return self._made[rest[0]]
        made = self._parts(kind, *rest)
        self._made.append(made)
        return made

    def _parts(self, kind: str, what: Any, fields: dict | None = None) -> Any:
        if kind in ("list", "tuple"):
            parts = [self.unpack(each) for each in what]
            return parts if kind == "list" else tuple(parts)
        if kind == "dict":
            return {self.unpack(k): self.unpack(v) for k, v in what}
        if kind in ("array", "tensor"):
            array = self._array(*what)
            return array if kind == "array" else _tensor(array, self.device)
        if kind == "object" and what in _STORABLE:
            known = {f.name for f in _fields(_STORABLE[what])}
            if fields is None or fields.keys() != known:
                raise ValueError(f"its {what} has other fields than this version's")
            parts = {key: self.unpack(value) for key, value in fields.items()}
            return _STORABLE[what](**parts)
        raise ValueError(f"its structure holds an unknown {kind} {what}")

    def _array(self, at: int, dtype: str, shape: list[int], order: str) -> NDArray:
        kind = np.dtype(dtype)
        end = at + math.prod(shape) * kind.itemsize
        if kind.hasobject or min(at, *shape, 0) < 0 or end > len(self.data):
            raise ValueError("its arrays are not where they should be")
        return self.data[at:end].view(kind).reshape(shape, order=order).copy(order)


def _tensor(array: NDArray, device: str) -> Any:
    import torch  # FQI does without

    return torch.from_numpy(array).to(device)


def _fields(cls: type) -> list[dataclasses.Field]:
    return [f for f in dataclasses.fields(cls) if not f.metadata.get("derived")]


def _text(document: Any) -> NDArray[np.uint8]:
    return np.frombuffer(json.dumps(document).encode(), np.uint8)


def _json(stored: NDArray[np.uint8]) -> Any:
    return json.loads(stored.tobytes())
