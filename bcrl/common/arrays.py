"""Code that runs lane by lane, or on NumPy arrays and, on a GPU, on torch tensors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bcrl.common.compiling import guvectorize


def per_lane(signature: str, layout: str) -> Callable[[Callable], np.ufunc]:
    """A decorator that compiles a function of one lane for arrays with leading axes.

    signature: types of the arguments, outputs last, e.g. "(f8[:], f8, i8[:])"; layout:
    their core axes, e.g. "(a),()->()". A NumPy generalised ufunc comes out, which has
    little cost a call: numba's own object around it has several times as much.
    """

    def decorate(function: Callable) -> np.ufunc:
        compiled = guvectorize([signature], layout, cache=True)(function)
        return compiled.ufunc

    return decorate


def namespace(array: Any) -> Any:
    """The library whose functions work on `array`: numpy, or torch for its tensors."""
    if isinstance(array, (np.ndarray, np.generic)):
        return np
    import torch

    return torch


def like(constant: np.ndarray, array: Any) -> Any:
    """A NumPy constant as an array of the library, type and device of `array`."""
    if namespace(array) is np:
        return constant
    return namespace(array).as_tensor(constant, dtype=array.dtype, device=array.device)


def ndtri(u: Any) -> Any:
    """The standard normal quantile of uniforms u in [0, 1); u = 0 counts as 2⁻⁵⁴."""
    least = 2.0**-54
    if namespace(u) is np:
        from scipy.special import ndtri as quantile

        return quantile(np.maximum(u, least))
    return namespace(u).special.ndtri(u.clamp(min=least))
