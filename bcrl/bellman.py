"""The one regression target that plain and boosted value iteration share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def residual_target(
    reward: NDArray[np.float64],
    absorbing: NDArray[np.bool_],
    next_q: NDArray[np.float64],
    base: NDArray[np.float64],
    gamma: float,
) -> NDArray[np.float64]:
    """ϱ(s, a) ← r + γ (1 − absorbing) max_a' Q(s', a') − base(s, a) (paper, Eq. 5).

    `next_q` has shape (n, A) and is the whole Q = base + ϱ at the next states; the
    other arrays have shape (n,). With base = 0 this is the plain algorithm's target.
    """
    return reward + gamma * np.where(absorbing, 0.0, next_q.max(-1)) - base


def frozen_part(
    reward: NDArray[np.float64],
    absorbing: NDArray[np.bool_],
    next_base: NDArray[np.float64],
    base: NDArray[np.float64],
    gamma: float,
    maxima: str = "one",
    mask_at_goal: bool = True,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """c (n,), discount (n,) and b (n, A) with target c + discount · max_a' (ϱ + b)(s').

    All of a transition's target that stays as it is while ϱ is learned. With `one`
    maximum and the mask this is `residual_target`. With `two` the target bootstraps
    with max ϱ(s') + max base(s'), and without the mask an absorbing next state still
    counts with max base(s') [released]. Shapes as in `residual_target`.
    """
    discount = np.where(absorbing, 0.0, gamma)
    alone = np.zeros_like(reward) if mask_at_goal else np.where(absorbing, gamma, 0.0)
    if maxima == "two":
        alone = alone + discount
        inside = np.zeros_like(next_base)
    else:
        inside = next_base
    return reward + alone * next_base.max(-1) - base, discount, inside


def shaping(
    value: NDArray[np.float64],
    next_value: NDArray[np.float64],
    absorbing: NDArray[np.bool_],
    gamma: float,
    zero_at_goal: bool = True,
) -> NDArray[np.float64]:
    """γ V(s') − V(s), with V(s') = 0 in absorbing s' if `zero_at_goal` (Ng 1999)."""
    if zero_at_goal:
        next_value = np.where(absorbing, 0.0, next_value)
    return gamma * next_value - value
