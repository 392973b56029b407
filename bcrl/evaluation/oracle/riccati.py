"""The optimal linear controller of an LQ task: a discounted Riccati equation."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from bcrl.envs.linear_system import LinearSystem
from bcrl.errors import BcrlError


def gain(env: LinearSystem) -> NDArray[np.float64]:
    """K (k, d) of the optimal policy a = K s; BcrlError if `env` is not LQ.

    For s' = A s + B a and rewards −s'ᵀ Q s' − aᵀ R a discounted by γ:
    K = −(R + Bᵀ X B)⁻¹ Bᵀ X A with X = Q + γ Aᵀ X (A + B K), the costs of the new state
    and of all that follows.
    """
    if env.linear_quadratic is None:
        raise BcrlError(f"{env.name}, task={env.task}: is not linear-quadratic")
    a, b, q, r = env.linear_quadratic
    root = math.sqrt(env.gamma)
    x = solve_discrete_are(root * a, root * b, q, env.gamma * r)
    return -np.linalg.solve(r + b.T @ x @ b, b.T @ x @ a)
