"""Networks whose outputs are values in units of V and of advantages."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from bcrl.common.seed_axis import seeds_on
from bcrl.common.serialization import storable
from bcrl.q.functions import Values, each
from bcrl.q.networks.mlp import Adam, DeepQ, Networks


@storable
@dataclass(frozen=True)
class InUnits:
    """Q = m + σ_V z̄ + σ_A (z − z̄): z are a network's outputs, z̄ is their mean.

    V is far larger than the differences between actions. With separate units, these
    keep the precision of the network's floats.
    """

    deep: DeepQ
    mean: NDArray[np.float64] = field(metadata=seeds_on(0))  # (S,) m
    value_scale: NDArray[np.float64] = field(metadata=seeds_on(0))  # (S,) σ_V
    advantage_scale: NDArray[np.float64] = field(metadata=seeds_on(0))  # (S,) σ_A

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        z = self.deep(states, n_actions)
        return each(states, lambda s: self.plain(s, z[s]))

    def plain(self, s: int, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """The values of the seed with index s from outputs z (n, A)."""
        v = z.mean(-1, keepdims=True)
        own = self.value_scale[s] * v + self.advantage_scale[s] * (z - v)
        return self.mean[s] + own

    def in_units(self, s: int, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """The outputs for values (n, A): the inverse of `plain`."""
        v = values.mean(-1, keepdims=True)
        own = (v - self.mean[s]) / self.value_scale[s]
        return own + (values - v) / self.advantage_scale[s]

    def absorbed(self) -> DeepQ:
        """Networks with the values themselves as outputs, to be trained further."""
        flat = self.deep.online.flat.clone()
        n = self.deep.online.sizes[-1]
        for s, (weights, biases) in enumerate(
            zip(*Networks(self.deep.online.sizes, flat).layers[-1], strict=True)
        ):
            mix = self.advantage_scale[s] * np.eye(n)
            mix += (self.value_scale[s] - self.advantage_scale[s]) / n
            turn = torch.from_numpy(mix).to(flat)
            weights.copy_(weights @ turn)
            biases.copy_(biases @ turn + float(self.mean[s]))
        online, target = (
            Networks(self.deep.online.sizes, x) for x in (flat, flat.clone())
        )
        return DeepQ(online, target, Adam.of(flat, self.deep.optimiser.rate))
