"""Q-functions quadratic in state and action: what LSPI learns in an LQ task."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bcrl.common.arrays import writable
from bcrl.common.compiling import kept
from bcrl.common.seed_axis import seeds_on
from bcrl.common.serialization import storable
from bcrl.q.functions import Values, check_states

#: products: all z_i z_j, i ≤ j [released]; linear_quadratic: the z_i besides [paper].
FEATURES = ("products", "linear_quadratic")


def features(z: NDArray[np.float64], kind: str) -> NDArray[np.float64]:
    """φ(z) of state-action vectors z (..., m): m(m+1)/2 products, or m more."""
    i, j = np.triu_indices(z.shape[-1])
    products = z[..., i] * z[..., j]
    return products if kind == "products" else np.concatenate([z, products], -1)


@storable
@dataclass(frozen=True)
class Quadratic:
    """Q(s, a) = zᵀ M z + lᵀ z with z = (s, a), for S seeds and a table of actions."""

    #: (S, m, m), symmetric
    matrix: NDArray[np.float64] = field(metadata=seeds_on(0))
    linear: NDArray[np.float64] = field(metadata=seeds_on(0))  # (S, m)
    actions: NDArray[np.float64]  # (A, k)

    @classmethod
    def from_weights(
        cls, theta: NDArray[np.float64], kind: str, m: int, actions: NDArray[np.float64]
    ) -> "Quadratic":
        """From the weights θ (S, F) of `features(z, kind)` for z of length m."""
        linear, products = np.zeros((len(theta), m)), theta
        if kind == "linear_quadratic":
            linear, products = theta[:, :m], theta[:, m:]
        matrix = np.zeros((len(theta), m, m))
        i, j = np.triu_indices(m)
        matrix[:, i, j] = products / 2.0
        return cls(matrix + matrix.transpose(0, 2, 1), linear, actions)

    @cached_property
    def _parts(self) -> tuple[NDArray, NDArray, NDArray]:
        """Values are xᵀ P x + x·C + c: P (S, d, d), C (S, d, A), c (S, A)."""
        act = self.actions
        d = self.matrix.shape[-1] - act.shape[1]
        cross = 2.0 * self.matrix[:, :d, d:] @ act.T + self.linear[:, :d, None]
        alone = (act @ self.matrix[:, d:, d:] * act).sum(-1)
        pure, alone = self.matrix[:, :d, :d], alone + self.linear[:, d:] @ act.T
        return writable(pure), writable(cross), writable(alone)

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        parts = self._parts
        check_states(states, len(parts[0]), len(parts[0][0]))
        if isinstance(states, np.ndarray):
            return _values(writable(states), *parts)
        return [
            _values(writable(x)[None], *(part[s : s + 1] for part in parts))[0]
            for s, x in enumerate(states)
        ]


@kept(nogil=True)
def _values(states, pure, cross, alone):
    """xᵀ P x + x·C + c of each seed at states x (S, n, d), (S, n, A)."""
    n_seeds, n, d = states.shape
    values = np.empty((n_seeds, n, alone.shape[1]))
    for s in range(n_seeds):
        for i in range(n):
            x, square = states[s, i], 0.0
            for j in range(d):
                for k in range(d):
                    square += x[j] * pure[s, j, k] * x[k]
            for a in range(alone.shape[1]):
                value = alone[s, a] + square
                for j in range(d):
                    value += x[j] * cross[s, j, a]
                values[s, i, a] = value
    return values
