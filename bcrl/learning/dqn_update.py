"""DQN's gradient step on S seeds: batched on any device, compiled on a CPU."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from bcrl.learning import Floats
from bcrl.learning.replay import Replay
from bcrl.q.networks import cpu
from bcrl.q.networks.mlp import DeepQ, Networks

#: (indices (T, S, B), next states (S, d)) → losses (S,), and ϱ's values (S, A) at these
#: states, or None. The update uses the first of the T batches; the others belong to the
#: steps before the target network changes.
Update = Callable[
    [NDArray[np.int64], Floats], tuple[Floats, NDArray[np.float32] | None]
]


def updater(deep: DeepQ, replay: Replay) -> Update:
    """The function that makes one gradient step from the batches at `indices`.

    The loss is the mean of a batch's smooth-L1 errors. Both implementations compute the
    same, and no seed's result depends on the other seeds.
    """
    if deep.online.flat.device.type == "cpu":
        return one_by_one(deep, replay)
    return batched(deep, replay)


def batched(deep: DeepQ, replay: Replay) -> Update:
    """Stacked matrix products in torch."""
    online, target = deep.online, deep.target
    gradient = Networks(online.sizes, torch.zeros_like(online.flat))

    def update(indices: NDArray[np.int64], next_states: Floats) -> tuple[Floats, None]:
        drawn = replay.sample(torch.from_numpy(indices[0]).to(online.flat.device))
        x, next_x, next_base, fixed, discount, action = drawn
        action = action.long()
        best = (target.forward(next_x) + next_base).amax(-1, keepdim=True)  # (S, B, 1)
        y = torch.addcmul(fixed, discount, best)
        output = online.forward(x)  # (S, B, A)
        error = output.gather(-1, action) - y
        clipped = error.clamp(-1.0, 1.0)
        # ∂loss/∂output of the mean over the batch, summed over seeds
        slope = torch.zeros_like(output)
        slope.scatter_(-1, action, clipped / error.shape[1])
        online.backward(x, slope, gradient)
        deep.optimiser.step(online.flat, gradient.flat)
        return (clipped * (error - 0.5 * clipped)).mean((1, 2)).cpu().numpy(), None

    return update


def one_by_one(deep: DeepQ, replay: Replay) -> Update:
    """One seed after the other in compiled code."""
    buffers = (deep.online.flat, deep.target.flat, deep.optimiser.moments)
    networks = tuple(buffer.numpy() for buffer in buffers)
    sizes, layout = np.array(deep.online.sizes), (replay.d, replay.n_actions)
    stored = (replay.rows.numpy(), replay.bootstrap, replay.valid)

    def update(
        indices: NDArray[np.int64], next_states: Floats
    ) -> tuple[Floats, NDArray[np.float32]]:
        adam, loss = deep.optimiser.next_step(), np.empty(len(networks[0]))
        next_values = np.empty((len(loss), replay.n_actions), np.float32)
        if len(indices) > 1:
            cpu.renew_ahead(networks[1], sizes, stored, replay.size, indices, layout)
        states, outputs = next_states.astype(np.float32), (loss, next_values)
        cpu.update(networks, sizes, stored, indices[0], layout, adam, states, *outputs)
        return loss, next_values

    return update
