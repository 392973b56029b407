"""The one regression target that plain and boosted value iteration share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bcrl.common.arrays import per_lane


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


def precompute_target(
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
    two = maxima == "two"
    return _precompute_target(
        reward, absorbing, next_base, base, gamma, two, not mask_at_goal
    )


@per_lane(
    "(f8, b1, f8[:], f8, f8, b1, b1, f8[:], f8[:], f8[:])",
    "(),(),(a),(),(),(),()->(),(),(a)",
)
def _precompute_target(
    reward, absorbing, next_base, base, gamma, two, unmasked, fixed, discount, inside
):
    best = next_base[0]
    for a in range(len(next_base)):
        best = max(best, next_base[a])
        inside[a] = 0.0 if two else next_base[a]
    discount[0] = 0.0 if absorbing else gamma
    alone = gamma if unmasked and absorbing else 0.0
    if two:
        alone += discount[0]
    fixed[0] = reward + alone * best - base


def shaping(
    value: NDArray[np.float64],
    next_value: NDArray[np.float64],
    absorbing: NDArray[np.bool_],
    gamma: float,
    zero_at_goal: bool = True,
) -> NDArray[np.float64]:
    """γ V(s') − V(s), with V(s') = 0 in absorbing s' if `zero_at_goal` (Ng 1999)."""
    return _shaping(value, next_value, absorbing, gamma, zero_at_goal)


@per_lane("(f8, f8, b1, f8, b1, f8[:])", "(),(),(),(),()->()")
def _shaping(value, next_value, absorbing, gamma, zero_at_goal, extra):
    extra[0] = (0.0 if zero_at_goal and absorbing else gamma * next_value) - value
