"""The forest's two compiled entry points, cached on disk by what they are made of.

numba compares only the file of a cached function with its cache. The parts of these two
stand in several files, so a fingerprint of all of them is woven in: numba keys a cached
function by the constants it closes over, and code of an older version is never run.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

from numba import njit

from bcrl.q import descend, grow, kernel, lanes, rows


def _fingerprint() -> int:
    digest = hashlib.sha256()
    for module in (lanes, kernel, rows, grow, descend):
        digest.update(Path(module.__file__).read_bytes())
    return int.from_bytes(digest.digest()[:6], "big")


def _entry_points(fingerprint: int) -> tuple[Callable, Callable]:
    @njit(cache=True, nogil=True)
    def grow_forest(x, y, multiplicity, seeds, queries, settings, keep):
        _ = fingerprint
        return grow.grow_forest(x, y, multiplicity, seeds, queries, settings, keep)

    @njit(cache=True, nogil=True)
    def predict_forest(nodes, values, first, x):
        _ = fingerprint
        return descend.predict_forest(nodes, values, first, x)

    return grow_forest, predict_forest


grow_forest, predict_forest = _entry_points(_fingerprint())
