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
