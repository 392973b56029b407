"""Arrays cached on disk between runs; every failure means computing again."""

from __future__ import annotations

import contextlib
import hashlib
import os
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bcrl.common.files import make_directory, user_folder, write_atomically
from bcrl.errors import BcrlError


def directory() -> Path | None:
    """${BCRL_CACHE:-${XDG_CACHE_HOME:-~/.cache}/bcrl}; None without a home."""
    if chosen := os.environ.get("BCRL_CACHE"):
        with contextlib.suppress(RuntimeError):
            return Path(chosen).expanduser()
    base = user_folder("XDG_CACHE_HOME", ".cache")
    return base / "bcrl" if base else None


def cached(
    name: str, sources: Sequence[Path], compute: Callable[[], NDArray[np.int64]]
) -> NDArray[np.int64]:
    """`compute()`, or the array cached for this `name` and these source files.

    The file is an NPZ, whose checksum reveals damage; a damaged one is replaced
    (atomically, for concurrent runs). A folder that cannot be read or written is no
    error.
    """
    folder = directory()
    if folder is None:
        return compute()
    code = hashlib.sha256(b"".join(source.read_bytes() for source in sources))
    path = folder / f"{name}_{code.hexdigest()[:20]}.npz"
    unreadable = (OSError, ValueError, LookupError, EOFError, zipfile.BadZipFile)
    with contextlib.suppress(*unreadable), np.load(path, allow_pickle=False) as stored:
        return stored["array"]
    array = compute()
    with contextlib.suppress(BcrlError):
        make_directory(folder, "BCRL_CACHE")
        write_atomically(path, lambda file: np.savez(file, array=array))
    return array
