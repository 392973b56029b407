"""Regression targets of plain and boosted value iteration, and reward shaping."""

import numpy as np

from bcrl.learning import Booleans, Floats
from bcrl.learning.transfer import Boost


def residual_target(
    reward: Floats, absorbing: Booleans, next_q: Floats, base: Floats, gamma: float
) -> Floats:
    """r + γ (1 − absorbing) max_a' Q(s', a') − base(s, a): what ϱ(s, a) is fitted to.

    `next_q` (n, A) is Q = base + ϱ at the next states; the other arrays have shape
    (n,). With base = 0 this is the target of plain value iteration. Source: paper,
    Eq. 5.
    """
    return reward + gamma * np.where(absorbing, 0.0, next_q.max(-1)) - base


def precompute_target(
    reward: Floats,
    absorbing: Booleans,
    next_base: Floats,
    base: Floats,
    gamma: float,
    boost: Boost,
) -> tuple[Floats, Floats, Floats]:
    """The parts of a target that ϱ does not change: b (n, A), c (n,), discount (n,).

    The target is c + discount · max_a' (ϱ + b)(s', a'). With `one` maximum and the mask
    it is `residual_target`. With `two` it bootstraps with max ϱ(s') + max base(s').
    Without the mask, max base(s') counts in an absorbing next state, too [released].
    """
    discount, two = np.where(absorbing, 0.0, gamma), boost.maxima == "two"
    weight = discount if two else np.zeros_like(discount)
    if not boost.mask_at_goal:
        weight = np.where(absorbing, gamma, weight)
    if two or not boost.mask_at_goal:
        reward = reward + weight * next_base.max(-1)
    return np.zeros_like(next_base) if two else next_base, reward - base, discount


def shaping(
    value: Floats,
    next_value: Floats,
    absorbing: Booleans,
    gamma: float,
    zero_at_goal: bool = True,
) -> Floats:
    """γ V(s') − V(s), with V(s') = 0 in absorbing s' if `zero_at_goal` (Ng 1999)."""
    return np.where(zero_at_goal & absorbing, 0.0, gamma * next_value) - value
