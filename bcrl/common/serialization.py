"""Objects as JSON and arrays, and back: the content of checkpoints.

Only plain values, arrays, tensors and classes marked `storable` can be stored, and only
these come back: reading a file runs none of its content.
"""

import dataclasses
import importlib
import io
import json
import math
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from bcrl.errors import BcrlError

#: Metadata of a dataclass's field that isn't stored: it follows from the others.
DERIVED = {"derived": True}
_STORABLE: dict[str, type] = {}
_OURS = ("bcrl.envs.", "bcrl.learning.", "bcrl.q.")  # where storable classes are
_PLAIN = (type(None), bool, int, float, str)


def storable(cls: type) -> type:
    """Mark a dataclass as one whose instances are stored field by field."""
    _STORABLE[_name(cls)] = cls
    return cls


def is_storable(cls: type) -> bool:
    """Whether instances of a class are stored field by field."""
    return _STORABLE.get(_name(cls)) is cls


def is_derived(field: dataclasses.Field) -> bool:
    """Whether a dataclass's field isn't stored."""
    return bool(field.metadata.get("derived"))


def _name(cls: type) -> str:
    """A class's name in a file, with its module: a user's `Sum` is not ours."""
    return f"{cls.__module__}.{cls.__qualname__}"


def _class(name: str) -> type:
    """The storable class of a name; of our classes, the module is imported."""
    if name not in _STORABLE and name.startswith(_OURS):  # networks import torch
        importlib.import_module(name.rpartition(".")[0])
    return _STORABLE[name]


def _fields(cls: type) -> list[str]:
    """The names of a dataclass's fields that are stored."""
    return [f.name for f in dataclasses.fields(cls) if not is_derived(f)]


def write_content(
    file: BinaryIO, about: dict, content: Any, given: Sequence[Any]
) -> None:
    """Store `content` as an NPZ, with a JSON document `about` it.

    Objects of `given` are not stored but named by their place in it. An object that
    occurs twice is stored once and comes back as one object. Raises TypeError for
    objects that can't be stored.
    """
    packer = _Packer(given)
    texts = {"about": about, "structure": packer.pack(content)}
    texts = {key: json.dumps(document).encode() for key, document in texts.items()}
    # One array of bytes: each array of an NPZ costs a fraction of a millisecond.
    data = np.concatenate([np.empty(0, np.uint8), *packer.bytes])
    np.savez(file, **texts, data=data)


def written(about: dict, content: Any, given: Sequence[Any]) -> bytes:
    """What `write_content` writes."""
    write_content(file := io.BytesIO(), about, content, given)
    return file.getvalue()


def relabelled(path: Path, about: dict) -> bytes:
    """A stored file with another document about its content."""
    with _opened(path) as stored:
        parts = {name: stored(name) for name in ("structure", "data")}
    np.savez(file := io.BytesIO(), about=json.dumps(about).encode(), **parts)
    return file.getvalue()


def read_about(path: Path) -> dict:
    """The document about an NPZ's content; BcrlError if the file can't be read."""
    with _opened(path) as stored:
        return dict(json.loads(stored("about").tobytes()))


def read_content(path: Path, given: Sequence[Any], device: str = "cpu") -> Any:
    """What `write_content` stored, tensors on `device`; BcrlError if damaged."""
    with _opened(path) as stored:
        structure = json.loads(stored("structure").tobytes())
        return _Unpacker(stored("data"), given, device).unpack(structure)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """An open NPZ; all that may be wrong with it becomes a BcrlError."""
    try:
        with zipfile.ZipFile(path) as stored:
            yield partial(_bytes, stored)
    except Exception as error:
        why = f"can't be read ({error}); remove it, then its seeds start anew"
        raise BcrlError(f"{path} {why}") from error


def _bytes(stored: zipfile.ZipFile, name: str) -> NDArray[np.uint8]:
    """The bytes of an array or text; they take no more memory than the file."""
    info = stored.getinfo(f"{name}.npy")
    if info.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{name} is compressed")
    with stored.open(info) as member:
        np.lib.format.read_magic(member)
        shape, _, dtype = np.lib.format.read_array_header_1_0(member)
        data = np.frombuffer(member.read(), np.uint8)
    if math.prod(shape) * dtype.itemsize != data.size:
        raise ValueError(f"{name} is cut")
    return data


class _Packer:
    def __init__(self, given: Sequence[Any]) -> None:
        self.bytes: list[NDArray[np.uint8]] = []
        self._length = 0
        self._kept = list(given)  # so that no id in `_seen` is used again
        self._seen = {id(thing): place for place, thing in enumerate(given)}

    def pack(self, thing: Any) -> Any:
        thing = thing.item() if isinstance(thing, np.generic) else thing
        kind, name, parts = type(thing), type(thing).__name__, None
        if kind in _PLAIN:
            return thing
        if id(thing) in self._seen:
            return ["same", self._seen[id(thing)]]
        if kind is np.ndarray and not thing.dtype.hasobject:
            name, parts = "array", self._array(thing)
        elif name == "Tensor" and kind.__module__.startswith("torch"):
            name, parts = "tensor", self._array(thing.detach().cpu().numpy())
        elif kind in (list, tuple):
            parts = [self.pack(part) for part in thing]
        elif kind is dict:
            parts = [[self.pack(k), self.pack(v)] for k, v in thing.items()]
        elif is_storable(kind):
            fields = {key: self.pack(getattr(thing, key)) for key in _fields(kind)}
            name, parts = "object", [_name(kind), fields]
        else:
            raise TypeError(f"{_name(kind)} is not storable")
        self._seen[id(thing)] = len(self._kept)
        self._kept.append(thing)
        return [name, parts]

    def _array(self, array: NDArray) -> list:
        fortran = array.flags.f_contiguous and not array.flags.c_contiguous
        order: Any = "F" if fortran else "C"
        flat = np.ascontiguousarray(array.reshape(-1, order=order))
        self.bytes.append(flat.view(np.uint8))
        start, self._length = self._length, self._length + array.nbytes
        return [start, array.dtype.str, list(array.shape), order]


class _Unpacker:
    def __init__(self, data: NDArray, given: Sequence[Any], device: str) -> None:
        self.data, self.device, self.made = data, device, list(given)
        self._end = 0  # of the array before

    def unpack(self, packed: Any) -> Any:
        if isinstance(packed, _PLAIN):
            return packed
        kind, parts = packed
        if kind == "same":
            return self.made[parts]
        whole: Any
        if kind == "array":
            whole = self._array(*parts)
        elif kind == "tensor":
            import torch  # FQI does not need it

            whole = torch.from_numpy(self._array(*parts)).to(self.device)
        elif kind in ("list", "tuple"):
            whole = [self.unpack(part) for part in parts]
            whole = whole if kind == "list" else tuple(whole)
        elif kind == "dict":
            whole = {self.unpack(k): self.unpack(v) for k, v in parts}
        elif kind == "object" and parts[1].keys() == set(_fields(_class(parts[0]))):
            fields = {key: self.unpack(value) for key, value in parts[1].items()}
            whole = _class(parts[0])(**fields)
        else:
            raise ValueError(f"this version knows no such {kind}")
        self.made.append(whole)
        return whole

    def _array(self, start: int, dtype: str, shape: list[int], order: Any) -> NDArray:
        kind = np.dtype(dtype)
        end = start + math.prod(shape) * kind.itemsize
        # Arrays that overlap could take far more memory than the file has bytes.
        inside = start == self._end and min(*shape, 0, 0) == 0 and end <= len(self.data)
        if kind.hasobject or not inside:
            raise ValueError("its arrays lie outside of the file, or overlap")
        self._end = end
        return self.data[start:end].view(kind).reshape(shape, order=order).copy(order)
