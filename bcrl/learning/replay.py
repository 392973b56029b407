"""A replay buffer for S seeds, and the gradient steps that learn from it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from bcrl.common.serialization import storable
from bcrl.learning import Floats
from bcrl.q.networks import cpu
from bcrl.q.networks.mlp import DeepQ, Networks


@storable
@dataclass(eq=False)
class Replay:
    """The last transitions of each seed, with precomputed targets.

    The target of ϱ(s, a) is fixed + discount · max_a' (ϱ + next_base)(s', a'). All but
    ϱ is computed once, when a transition is stored. `bootstrap` caches the maximum by
    the target network, where `valid`.
    """

    #: (S, capacity, 2 d + A + 3): s, s', next_base, fixed, discount, action
    rows: torch.Tensor
    bootstrap: NDArray[np.float32]  # (S, capacity)
    valid: NDArray[np.bool_]  # (S, capacity); none is when the target network changes
    d: int
    n_actions: int
    added: int = 0  # transitions of each seed, overwritten ones included

    def __post_init__(self) -> None:
        # NumPy's assignment costs a tenth of torch's; on a CPU the memory is the same.
        self.capacity = self.rows.shape[1]  # transitions of each seed that fit in
        self._host = (self.rows if self.rows.is_cpu else self.rows[:, :1].cpu()).numpy()

    @classmethod
    def empty(
        cls, n_seeds: int, capacity: int, d: int, n_actions: int, device: str
    ) -> "Replay":
        """A replay without transitions."""
        shape = (n_seeds, capacity)
        rows = torch.zeros((*shape, 2 * d + n_actions + 3), device=device)
        bootstrap, valid = np.zeros(shape, np.float32), np.zeros(shape, bool)
        return cls(rows, bootstrap, valid, d, n_actions)

    @property
    def size(self) -> int:
        """Transitions of each seed that are stored."""
        return min(self.added, self.capacity)

    def add(self, *transition: NDArray) -> None:
        """Store each seed's s, s', next_base, fixed, discount and action, (S, …)."""
        state, next_state, next_base, fixed, discount, action = transition
        d, index = self.d, self.added % self.capacity
        row = self._host[:, index if self.rows.is_cpu else 0]
        row[:, :d], row[:, d : 2 * d], row[:, 2 * d : -3] = state, next_state, next_base
        row[:, -3], row[:, -2], row[:, -1] = fixed, discount, action
        if not self.rows.is_cpu:
            self.rows[:, index] = torch.from_numpy(row)
        self.valid[:, index] = False
        self.added += 1

    def restate(self, next_base: Floats, fixed: Floats) -> None:
        """Replace these of all n transitions of each seed: (S, n, A) and (S, n)."""
        new = np.concatenate([next_base, fixed[..., None]], -1)
        self.rows[:, : self.size, 2 * self.d : -2] = torch.from_numpy(new)

    def indices(self, u: Floats, past: int = 0) -> NDArray[np.int64]:
        """Rows (T, S, B) that uniforms u (T, S, B) draw in T steps, with replacement.

        Step t comes after t + 1 − `past` more transitions have been added.
        """
        held = np.arange(1, len(u) + 1) + self.added - past
        return (u * np.minimum(held, self.capacity)[:, None, None]).astype(np.int64)


#: (indices (T, S, B), next states (S, d)) → losses (S,), and ϱ's values (S, A) at these
#: states, or None. One gradient step on the mean smooth-L1 error of the first of T
#: batches; the others belong to the steps before the target network changes. No seed's
#: result depends on the other seeds.
Update = Callable[[NDArray, Floats], tuple[Floats, NDArray[np.float32] | None]]


def batched(deep: DeepQ, replay: Replay) -> Update:
    """Stacked matrix products in torch, on any device."""
    online, target, device = deep.online, deep.target, replay.rows.device
    seed = torch.arange(len(online.flat), device=device)[:, None]
    widths = [replay.d, replay.d, replay.n_actions, 1, 1, 1]
    gradient = Networks(online.sizes, torch.zeros_like(online.flat))

    def update(indices: NDArray, next_states: Floats) -> tuple[Floats, None]:
        drawn = replay.rows[seed, torch.from_numpy(indices[0]).to(device)]  # (S, B, …)
        x, next_x, next_base, fixed, discount, chosen = drawn.split(widths, -1)
        action = chosen.long()
        best = (target.forward(next_x) + next_base).amax(-1, keepdim=True)  # (S, B, 1)
        y = torch.addcmul(fixed, discount, best)
        output = online.forward(x)  # (S, B, A)
        error = output.gather(-1, action) - y
        clipped = error.clamp(-1.0, 1.0)
        # ∂loss/∂output of the mean over the batch, summed over seeds
        slope = torch.zeros_like(output).scatter_(-1, action, clipped / error.shape[1])
        online.backward(x, slope, gradient)
        deep.optimiser.step(online.flat, gradient.flat)
        return (clipped * (error - 0.5 * clipped)).mean((1, 2)).cpu().numpy(), None

    return update


def one_by_one(deep: DeepQ, replay: Replay) -> Update:
    """One seed after the other in compiled code, on a CPU; computes the same."""
    buffers = (deep.online.flat, deep.target.flat, deep.optimiser.moments)
    networks = tuple(buffer.numpy() for buffer in buffers)
    sizes, layout = np.array(deep.online.sizes), (replay.d, replay.n_actions)
    stored = (replay.rows.numpy(), replay.bootstrap, replay.valid)

    def update(indices: NDArray, next_states: Floats) -> tuple[Floats, NDArray]:
        adam, loss = deep.optimiser.next_step(), np.empty(len(networks[0]))
        next_values = np.empty((len(loss), replay.n_actions), np.float32)
        if len(indices) > 1:
            cpu.renew_ahead(networks[1], sizes, stored, replay.size, indices, layout)
        states, outputs = next_states.astype(np.float32), (loss, next_values)
        cpu.update(networks, sizes, stored, indices[0], layout, adam, states, *outputs)
        return loss, next_values

    return update
