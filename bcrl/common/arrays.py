"""Compiled loops over lanes, and the normal quantile."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bcrl.common.compiling import guvectorize


def per_lane(signature: str, layout: str) -> Callable[[Callable], np.ufunc]:
    """A decorator that compiles a function of one lane for arrays with leading axes.

    signature: types of the arguments, outputs last, e.g. "(f8[:], f8, i8[:])"; layout:
    their core axes, e.g. "(a),()->()". The result is a NumPy generalised ufunc, which
    costs less per call than numba's own object around it.
    """

    def decorate(function: Callable) -> np.ufunc:
        return guvectorize([signature], layout, cache=True)(function).ufunc

    return decorate


def ndtri(u: NDArray[np.float64]) -> NDArray[np.float64]:
    """The standard normal quantile of uniforms u in [0, 1); u = 0 counts as 2⁻⁵⁴."""
    from scipy.special import ndtri as quantile

    return quantile(np.maximum(u, 2.0**-54))
