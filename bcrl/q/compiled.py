"""Compiled entry points, cached on disk by what they are made of.

numba compares only the file of a cached function with its cache. The parts of these
stand in several files, so a fingerprint of all of them is woven in: numba keys a cached
function by the constants it closes over, and code of an older version is never run.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

from bcrl.common.compiling import kept
from bcrl.q.forest import descend, grow, kernel, lanes, rows
from bcrl.q.networks import cpu, tiles


def _fingerprint(*modules: ModuleType) -> int:
    digest = hashlib.sha256()
    for module in modules:
        digest.update(Path(module.__file__).read_bytes())
    return int.from_bytes(digest.digest()[:6], "big")


_compiled = kept(nogil=True)


def _forest(fingerprint: int) -> tuple[Callable, Callable]:
    @_compiled
    def grow_forest(*given):
        _ = fingerprint
        return grow.grow_forest(*given)

    @_compiled
    def predict_forest(*given):
        _ = fingerprint
        return descend.predict_forest(*given)

    return grow_forest, predict_forest


def _networks(fingerprint: int) -> tuple[Callable, Callable, Callable]:
    @_compiled
    def outputs(*given):
        _ = fingerprint
        return cpu.outputs(*given)

    @_compiled
    def renew_ahead(*given):
        _ = fingerprint
        return cpu.renew_ahead(*given)

    @_compiled
    def update(*given):
        _ = fingerprint
        return cpu.update(*given)

    return outputs, renew_ahead, update


grow_forest, predict_forest = _forest(_fingerprint(lanes, kernel, rows, grow, descend))
outputs, renew_ahead, update = _networks(_fingerprint(lanes, tiles, cpu))
