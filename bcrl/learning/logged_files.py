"""Files of logged transitions, as named arrays: NPZ, Parquet and Minari's folders.

Reading runs no code of a file. Sizes in headers are checked before memory is taken.
"""

import functools
import hashlib
import importlib
import json
import math
import os
import textwrap
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from bcrl.common.files import write_atomically
from bcrl.errors import ConfigError

MINARI = "minari:"  # what the name of a Minari dataset begins with
_NUMBERS, _INTEGERS = ("fiu", "finite numbers"), ("iu", "integers")
#: The arrays: NumPy's kinds of their type, in words, and how many axes they have.
SCHEME = {
    "observation": (*_NUMBERS, 2),
    "action": (*_INTEGERS, 1),
    "reward": (*_NUMBERS, 1),
    "next_observation": (*_NUMBERS, 2),
    "absorbing": ("b", "booleans", 1),
    "episode": (*_INTEGERS, 1),
    "task": (*_INTEGERS, 1),
}
NEEDED = tuple(SCHEME)[:5]
TERMINATED = "terminated"  # Gymnasium's word for `absorbing`
ENDINGS = (".npz", ".parquet")
KNOWN = (*SCHEME, TERMINATED)  # what else a file has is not read
#: Compressed files may take so many times their size in memory, and small ones 64 MiB.
_RATIO, _SMALL = 200, 64 * 2**20
_NPY = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}

Arrays = dict[str, NDArray]


def unusable(data: object, why: str) -> ConfigError:
    """The error about logged data: a path, a name or transitions."""
    return ConfigError("algorithm.dataset", data, why)


def locate(name: str) -> Path:
    """The file or Minari folder that a path or `minari:ID` names."""
    place, why = os.path.abspath(name), "is neither own nor shared, nor an existing "
    why += "*.npz or *.parquet file, nor a Minari dataset (its folder, or minari:ID)"
    if name.startswith(MINARI):
        root = os.environ.get("MINARI_DATASETS_PATH", "~/.minari/datasets")
        identifier = name.removeprefix(MINARI)
        place = os.path.join(os.path.expanduser(root), identifier)
        why = f"there is no {place}; `minari download {identifier}` gets a public one"
    for folder in (place, os.path.join(place, "data")):
        if os.path.isfile(os.path.join(folder, "metadata.json")):
            return Path(folder)
    if os.path.isfile(place) and place.endswith(ENDINGS):
        return Path(place)
    raise unusable(name, why)


def content_sha256(path: Path) -> str:
    """The SHA-256 of a file, or of a folder's files and their names, hexadecimal."""
    try:
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        stats = [(file, file.stat()) for file in files if file.is_file()]
        return _sha256(path, tuple((f, s.st_size, s.st_mtime_ns) for f, s in stats))
    except OSError as error:
        raise unusable(path, f"can't be read: {error.strerror}") from error


@functools.lru_cache(maxsize=256)
def _sha256(path: Path, files: tuple[tuple[Path, int, int], ...]) -> str:
    """The same, computed once as long as sizes and times stay."""
    whole = hashlib.sha256()
    for file, *_ in files:
        with file.open("rb") as handle:
            digest = hashlib.file_digest(handle, "sha256").hexdigest()
        if file == path:
            return digest
        whole.update(f"{file.relative_to(path).as_posix()}\0{digest}\n".encode())
    return whole.hexdigest()


def load_arrays(path: Path) -> Arrays:
    """The arrays of a file that `locate` found; ConfigError if it can't be read."""
    try:
        if path.is_dir():
            return _read_minari(path)
        with path.open("rb") as file:
            return (_read_npz if path.suffix == ".npz" else _read_parquet)(path, file)
    except (ConfigError, MemoryError):
        raise
    except Exception as error:  # whatever a damaged file makes of its reader
        kinds = {".npz": "NPZ file", ".parquet": "Parquet file"}
        kind, found = kinds.get(path.suffix, "Minari dataset"), type(error).__name__
        found = textwrap.shorten(f"{found}: {error}", 200)
        why = f"can't be read as a whole {kind} ({found}); is it cut?"
        raise unusable(path, why) from error


def check_target(path: Path) -> None:
    """Raise ConfigError if `save_arrays` could not write a file of this name."""
    if path.suffix not in ENDINGS:
        raise ConfigError("path", path, f"its name must end in {' or '.join(ENDINGS)}")
    if not (folder := path.absolute().parent).is_dir():
        raise ConfigError("path", path, f"there is no folder {folder}; make it first")
    if path.suffix == ".parquet":
        _package("pyarrow", path)


def save_arrays(path: Path, arrays: Mapping[str, Any]) -> Path:
    """Write arrays of the scheme as NPZ or Parquet, by the name's end, atomically."""
    check_target(path)
    if path.suffix == ".npz":
        return write_atomically(path, lambda file: np.savez(file, **arrays))
    import pyarrow
    from pyarrow import parquet

    def column(values: NDArray) -> Any:
        flat = pyarrow.array(values.reshape(-1))
        if values.ndim == 1:
            return flat
        return pyarrow.FixedSizeListArray.from_arrays(flat, values.shape[1])

    table = pyarrow.table({name: column(values) for name, values in arrays.items()})
    return write_atomically(path, lambda file: parquet.write_table(table, file))


def _read_npz(path: Path, file: BinaryIO) -> Arrays:
    with zipfile.ZipFile(file) as archive:
        every = archive.infolist()
        members = [m for m in every if m.filename.removesuffix(".npy") in KNOWN]
        _check_size(path, sum(m.file_size for m in members), _most(path))
        for member in members:
            with archive.open(member) as head:
                header = _NPY[np.lib.format.read_magic(head)]
                shape, _, dtype = header(head)
                if head.tell() + math.prod(shape) * dtype.itemsize != member.file_size:
                    raise ValueError(f"{member.filename} has another size than it says")
    file.seek(0)
    with np.load(file, allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files if name in KNOWN}


def _read_parquet(path: Path, file: BinaryIO) -> Arrays:
    _package("pyarrow", path)
    from pyarrow import parquet

    table = parquet.ParquetFile(file)
    about, n_values = table.metadata, 0
    for n in range(about.num_columns):
        column = about.schema.column(n)
        if column.path.partition(".")[0] in KNOWN:
            # Texts of any length may be repeated; numbers have at most 8 bytes.
            text = "BYTE_ARRAY" in column.physical_type
            if text and column.logical_type.type != "FLOAT16":
                raise unusable(path, f"{column.path} has no numbers")
            groups = map(about.row_group, range(about.num_row_groups))
            n_values += sum(group.column(n).num_values for group in groups)
    _check_size(path, 8 * n_values, _most(path))
    names = [name for name in KNOWN if name in table.schema_arrow.names]
    read = table.read(columns=names)
    return {name: _values(path, name, read.column(name)) for name in names}


def _values(path: Path, name: str, column: Any) -> NDArray:
    """A Parquet column as an array: (n,), or (n, d) if it holds lists."""
    from pyarrow import compute, types

    flat, n = column, len(column)
    lists = types.is_list, types.is_large_list, types.is_fixed_size_list
    nested = any(is_list(column.type) for is_list in lists)
    if nested:
        lengths = compute.unique(compute.list_value_length(column)).to_pylist()
        if len(lengths) > 1:
            why = f"{name} has lists of the lengths {lengths[:5]}, expected one length"
            raise unusable(path, why)
        flat = compute.list_flatten(column)
    if empty := flat.null_count + column.null_count * nested:
        raise unusable(path, f"{name} has {empty} empty cells; fill them")
    return flat.to_numpy().reshape((n, len(flat) // max(1, n)) if nested else n)


def _read_minari(path: Path) -> Arrays:
    minari = _package("minari", path)
    from gymnasium import spaces
    from minari.serialization import deserialize_space

    about = json.loads((path / "metadata.json").read_text("utf-8"))
    # A dataset without spaces would make Minari construct its environment.
    each = (about[f"{name}_space"] for name in ("observation", "action"))
    observed, acted = map(deserialize_space, each)
    flat = isinstance(observed, spaces.Box) and len(observed.shape) == 1
    if not flat or not isinstance(acted, spaces.Discrete):
        found = textwrap.shorten(f"{observed} and {acted}", 200)
        why = f"has {found}, but needs flat Box observations (d,) and Discrete actions"
        raise unusable(path, why)
    most = _most(path)
    if about["data_format"] == "hdf5":
        h5py, sizes = _package("h5py", path), list[int]()
        with h5py.File(path / "main_data.hdf5") as file:
            file.visititems(lambda _, part: sizes.append(getattr(part, "nbytes", 0)))
        _check_size(path, sum(sizes), most)
    parts: dict[str, list[NDArray]] = {name: [] for name in (*NEEDED, "episode")}
    needed = 0
    for number, episode in enumerate(minari.MinariDataset(path).iterate_episodes()):
        steps, states = len(episode.actions), episode.observations
        if len(states) != steps + 1:
            raise ValueError(f"episode {number}: {len(states)} states, {steps} steps")
        own = states[:-1], episode.actions - acted.start, episode.rewards, states[1:]
        ends = episode.terminations, np.full(steps, number)
        for name, values in zip(parts, (*own, *ends), strict=True):
            parts[name].append(values)
            needed += values.nbytes
        _check_size(path, needed, most)  # Arrow's files do not say it before
    return {name: np.concatenate(values) for name, values in parts.items()}


def _most(path: Path) -> int:
    """The bytes of memory that the numbers of a file or folder may take."""
    files = path.rglob("*") if path.is_dir() else [path]
    return max(_RATIO * sum(file.stat().st_size for file in files), _SMALL)


def _check_size(path: Path, needed: int, most: int) -> None:
    """Raise ConfigError if a file would take far more memory than disk."""
    if needed > most:
        why = f"has {needed} bytes of numbers or more, over {_RATIO} times its size"
        raise unusable(path, f"{why}; is it damaged?")


def _package(name: str, wanted_by: object) -> Any:
    """An optional package; ConfigError with the line that installs it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        extra = "parquet" if name == "pyarrow" else "minari"
        why = f"needs {name}: pip install 'boosted-curriculum-rl[{extra}]'"
        raise unusable(wanted_by, why) from error
