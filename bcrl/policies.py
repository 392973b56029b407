"""Policies as pure functions of action values and uniform draws."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def greedy(q: NDArray[np.float64], u: NDArray[np.float64]) -> NDArray[np.intp]:
    """The best action of q (..., A); ties are broken uniformly by u (...) in [0, 1)."""
    best = q == q.max(-1, keepdims=True)
    rank = (u * best.sum(-1)).astype(np.intp)
    return (best.cumsum(-1) > rank[..., None]).argmax(-1)


def uniform(n_actions: int, u: NDArray[np.float64]) -> NDArray[np.intp]:
    """A uniformly random action from each u (...) in [0, 1)."""
    return (u * n_actions).astype(np.intp)
