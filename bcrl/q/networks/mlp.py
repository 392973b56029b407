"""Q-networks of S seeds side by side: stacked weights, batched products and Adam.

It runs on any device. On a CPU, the module `cpu` computes the same faster, in compiled
code; `DeepQ` and the DQN update choose by the device of the parameters.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from bcrl.common.seed_axis import seeds_on
from bcrl.common.serialization import DERIVED, storable
from bcrl.q.functions import Values, check_states
from bcrl.q.networks import cpu

Tensor = torch.Tensor


def xavier(rng: np.random.Generator, sizes: Sequence[int]) -> NDArray[np.float32]:
    """One network's weights and biases as a flat vector (P,), layer after layer.

    Weights (in, out) are Xavier-uniform with gain √2 (1 in the last layer), biases
    uniform on ±1/√in (Glorot and Bengio 2010; torch's default for biases).
    """
    parts, last = [], len(sizes) - 2
    for layer, (n_in, n_out) in enumerate(itertools.pairwise(sizes)):
        gain = math.sqrt(2.0) if layer < last else 1.0
        limit = gain * math.sqrt(6.0 / (n_in + n_out))
        parts.append(rng.uniform(-limit, limit, n_in * n_out))
        parts.append(rng.uniform(-1.0, 1.0, n_out) / math.sqrt(n_in))
    return np.concatenate(parts).astype(np.float32)


@storable
@dataclass(eq=False)
class Networks:
    """S perceptrons with ReLUs, one per seed; none depends on the others."""

    sizes: tuple[int, ...]  # the layers' widths (in, hidden …, out)
    flat: Tensor = field(metadata=seeds_on(0))  # all parameters, (S, P)
    _buffers: dict[int, list[Tensor]] = field(
        default_factory=dict, repr=False, metadata=DERIVED
    )

    def __post_init__(self) -> None:
        self.layers, at = [], 0  # weights (S, in, out) and biases (S, 1, out) in `flat`
        for n_in, n_out in itertools.pairwise(self.sizes):
            end = at + n_in * n_out
            weights = self.flat[:, at:end].view(-1, n_in, n_out)
            self.layers.append((weights, self.flat[:, None, end : end + n_out]))
            at = end + n_out

    def forward(self, x: Tensor) -> Tensor:
        """Outputs (S, n, out) at x (S, n, in); the next call with n overwrites them."""
        n = x.shape[1]
        if n not in self._buffers:
            self._buffers[n] = [x.new_empty((len(x), n, w)) for w in self.sizes[1:]]
        for layer, (weights, biases) in enumerate(self.layers):
            x = x.relu_() if layer else x
            x = torch.baddbmm(biases, x, weights, out=self._buffers[n][layer])
        return x

    def backward(self, x: Tensor, slope: Tensor, gradient: "Networks") -> None:
        """Write ∂loss/∂parameters into `gradient`, given slope = ∂loss/∂output.

        `slope` (S, n, out) belongs to the latest `forward(x)` with x (S, n, in).
        """
        activations = self._buffers[x.shape[1]]
        spare = gradient._buffers.setdefault(
            x.shape[1], [torch.empty_like(a) for a in activations]
        )
        for layer in reversed(range(len(self.layers))):
            before = activations[layer - 1] if layer else x
            weights, biases = gradient.layers[layer]
            torch.bmm(before.transpose(1, 2), slope, out=weights)
            torch.sum(slope, 1, keepdim=True, out=biases)
            if layer:
                onward = self.layers[layer][0].transpose(1, 2)
                slope = torch.bmm(slope, onward, out=spare[layer - 1])
                off = torch.ops.aten.threshold_backward.grad_input  # of the ReLU
                off(slope, before, 0, grad_input=slope)


@storable
@dataclass(eq=False)
class Adam:
    """Adam on parameters (S, P), each seed by itself (Kingma and Ba 2015)."""

    moments: Tensor = field(metadata=seeds_on(1))  # (2, S, P)
    rate: float
    betas: tuple[float, float] = (0.9, 0.999)
    eps: float = 1e-8
    steps: int = 0

    @classmethod
    def of(cls, parameters: Tensor, rate: float) -> "Adam":
        """For parameters (S, P) that have not been trained."""
        return cls(parameters.new_zeros((2, *parameters.shape)), rate)

    def next_step(self) -> tuple[float, float, float, float, float]:
        """Count a step; returns β1, β2, bias-corrected rate and scale, and ε."""
        self.steps += 1
        b1, b2 = self.betas
        rate = self.rate / (1.0 - b1**self.steps)
        scale = 1.0 / math.sqrt(1.0 - b2**self.steps)
        return b1, b2, rate, scale, self.eps

    def step(self, parameters: Tensor, gradient: Tensor) -> None:
        """One update of `parameters` in place."""
        b1, b2, rate, scale, eps = self.next_step()
        first, second = self.moments
        first.lerp_(gradient, 1.0 - b1)
        second.mul_(b2).addcmul_(gradient, gradient, value=1.0 - b2)
        first.masked_fill_(first.abs() < cpu.FADED, 0.0)
        second.masked_fill_(second < cpu.FADED, 0.0)
        parameters.addcdiv_(first, second.sqrt().mul_(scale).add_(eps), value=-rate)


@storable
@dataclass
class DeepQ:
    """The residual that DQN learns, as a Q-function, and all that training needs."""

    online: Networks
    target: Networks
    optimiser: Adam
    steps: int = 0  # environment steps since the networks were new

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        check_states(states, len(self.online.flat), self.online.sizes[0])
        if isinstance(states, np.ndarray):
            return self._values(self.online, states)
        one = [Networks(self.online.sizes, row) for row in self.online.flat.split(1)]
        pairs = zip(one, states, strict=True)
        return [self._values(own, x[None])[0] for own, x in pairs]

    def _values(self, networks: Networks, x: NDArray) -> NDArray[np.float64]:
        """Values (S, n, A) at states x (S, n, d)."""
        flat, inputs = networks.flat, np.ascontiguousarray(x, np.float32)
        if flat.device.type == "cpu":
            sizes = np.array(networks.sizes)
            return cpu.outputs(flat.numpy(), sizes, inputs).astype(np.float64)
        values = networks.forward(torch.from_numpy(inputs).to(flat.device))
        return values.cpu().numpy().astype(np.float64)
