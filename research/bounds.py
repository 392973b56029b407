"""The paper's error bounds as functions of measured numbers (section 5, appendix B).

In one task: Q^k, k = 0 … K, are the Q-functions of value iteration with a regressor S,
ϱ^k = T Q^(k-1) − Q^0 the target of S, ε^k = ϱ^k − S ϱ^k its error. Norms are one
number per iteration.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Norm = Callable[[Floats], float]


def sup(values: Floats) -> float:
    """The supremum norm."""
    return float(np.abs(values).max())


def mean_square(weights: Floats | None = None) -> Norm:
    """The L2 norm with weights µ, which sum to 1, or uniform ones."""

    def norm(values: Floats) -> float:
        return float(np.sqrt(np.average(values**2, weights=weights)))

    return norm


def ratio(above: float, below: float) -> float:
    """above / below; 0 if both are 0."""
    return above / below if below else 0.0 if above == 0.0 else np.inf


def lipschitz(
    operator: Callable[[Floats], Floats],
    pairs: Sequence[tuple[Floats, Floats]],
    norm: Norm,
) -> Floats:
    """‖T f − T g‖ / ‖f − g‖ of each pair; their largest estimates L from below."""
    return np.array(
        [ratio(norm(operator(f) - operator(g)), norm(f - g)) for f, g in pairs]
    )


def lipschitz_limit(transitions: Floats, mu: Floats, gamma: float) -> float:
    """An upper bound of L in the L2(µ) norm: γ √max (µP)(s') / µ(s', a').

    transitions (N, A, N): P(s' | s, a); mu (N, A) > 0, sums to 1. Farahmand (2011).
    """
    reached = np.einsum("sa,sat->t", mu, transitions)
    return float(gamma * np.sqrt((reached[:, None] / mu).max()))


def theorem_2(lam: float, lip: float, first: float, k: int) -> float:
    """Bound of ‖Q^k − Q*‖ by first = ‖Q^0 − Q*‖, for λ and L of all iterations."""
    grown = lip * (1.0 + lam)
    with np.errstate(over="ignore"):
        powers = np.power(grown, np.arange(k + 1.0))
    return float((lam * powers[:k].sum() + powers[k]) * first)


def corollary_1(lam: float, lip: float) -> float:
    """The least ε such that the error tends to at most ε ‖Q^0 − Q*‖; inf if none."""
    left = 1.0 - lip * (1.0 + lam)
    return lam / left if left > 0.0 else np.inf


def lemma_3(errors: Floats, residual_1: float, gamma: float) -> float:
    """Bound of ‖ϱ^k‖ in the supremum norm by ‖ε^1‖ … ‖ε^(k-1)‖ and ‖ϱ^1‖."""
    k = len(errors) + 1
    weights = (2 * gamma - (1 + gamma) * gamma ** np.arange(k - 1.0, 0.0, -1.0)) / (
        1 - gamma
    )
    return float(weights @ errors + (1 - gamma**k) / (1 - gamma) * residual_1)


def lemma_2(errors: Floats, residual_1: float, gamma: float, constant: float) -> float:
    """Bound of max |r + γ max Q^(k-1)(s') − Q^0(s, a)| over data, k − 1 = len(errors).

    The paper prints max |r| for `constant`, with which it can be too small. With
    max |r + γ max Q^0(s') − Q^0(s, a)| it holds.
    """
    if not len(errors):
        return constant
    before = lemma_3(errors[:-1], residual_1, gamma)
    return float(constant + gamma * (errors[-1] + before))


def propagation(errors: Floats, lip: float) -> float:
    """Σ_(i=1)^(k-1) L^i ‖ε^(k-i)‖, given ‖ε^1‖ … ‖ε^(k-1)‖ (Theorem 3)."""
    return float(lip ** np.arange(len(errors), 0.0, -1.0) @ errors)


def accumulated(errors: Floats, lip: float, first: float) -> float:
    """Bound of ‖Q^k − Q*‖ by ‖ε^1‖ … ‖ε^k‖ and ‖Q^0 − Q*‖: Σ L^i ‖ε^(k-i)‖ + L^k ‖…‖.

    It is what the proof of Theorem 2 has before it puts λ ‖ϱ^k‖ in place of ‖ε^k‖.
    """
    k = len(errors)
    return float(lip ** np.arange(k - 1.0, -1.0, -1.0) @ errors + lip**k * first)


def estimation(largest: float, samples: int, dimension: float) -> float:
    """Part (iii) of Theorem 4, from max |ϱ^k|, N and the VC dimension of F+.

    Source: Györfi et al. (2002), Theorem 11.5. It holds for B = max(|ϱ^k|, 1).
    """
    b = max(largest, 1.0)
    logs = np.log(42 * np.e) + 2 * np.log(480 * np.e * b**2) + 2 * np.log(samples)
    return float(5136 * b**4 * logs * dimension / samples)
