"""Integer tables kept on disk between runs; every failure means computing again."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bcrl.common.files import make_directory, user_folder, write_text
from bcrl.errors import BcrlError

SEAL = b"# sha256 "


def directory() -> Path:
    """${BCRL_CACHE:-${XDG_CACHE_HOME:-~/.cache}/bcrl}; RuntimeError without a home."""
    if chosen := os.environ.get("BCRL_CACHE"):
        return Path(chosen).expanduser()
    if base := user_folder("XDG_CACHE_HOME", ".cache"):
        return base / "bcrl"
    raise RuntimeError("no home")


def cached(
    name: str,
    inputs: str,
    sources: list[Path],
    shape: tuple[int, int],
    compute: Callable[[], NDArray[np.int64]],
) -> NDArray[np.int64]:
    """`compute()`, or what it gave before for these `inputs` and these source files.

    The table is a CSV sealed by its hash; a damaged one is computed again and replaced
    (atomically, so that concurrent runs never see half a file). A folder that cannot be
    read or written only costs the time.
    """
    try:
        key = hashlib.sha256(inputs.encode())
        for source in sources:
            key.update(source.read_bytes())
        path = directory() / f"{name}_{key.hexdigest()[:20]}.csv"
    except (OSError, RuntimeError):
        return compute()
    table = _read(path, shape)
    if table is None:
        table = compute()
        _write(path, table)
    return table


def _read(path: Path, shape: tuple[int, int]) -> NDArray[np.int64] | None:
    try:
        body, _, seal = path.read_bytes().rpartition(SEAL)
    except OSError:
        return None
    if hashlib.sha256(body).hexdigest().encode() != seal.strip():
        return None
    rows = [line.split(b",") for line in body.split()]
    table = np.array(rows, dtype=np.int64)
    return table if table.shape == shape else None


def _write(path: Path, table: NDArray[np.int64]) -> None:
    body = "".join(",".join(map(str, row)) + "\n" for row in table.tolist())
    seal = SEAL.decode() + hashlib.sha256(body.encode()).hexdigest() + "\n"
    with contextlib.suppress(BcrlError):
        make_directory(path.parent, "BCRL_CACHE")
        write_text(path, body + seal)
