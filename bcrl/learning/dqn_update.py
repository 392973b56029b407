"""DQN's gradient step on S seeds: batched on any device, compiled on a CPU."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from bcrl.learning.replay import Replay
from bcrl.q import compiled
from bcrl.q.networks.mlp import DeepQ, Networks

#: (places (T, S, B), next states (S, d)) → losses (S,), and the network's values (S, A)
#: at these states if they were cheap to have. The update is on the first of the
#: batches, the others are of steps to come before the target changes.
Update = Callable[
    [NDArray[np.int64], NDArray[np.float64]],
    tuple[NDArray[np.float64], NDArray[np.float32] | None],
]


def updater(deep: DeepQ, replay: Replay) -> Update:
    """The function that makes one gradient step from the batches at `places`.

    Losses are means over a batch of smooth-L1. Both ways compute the same
    (tests/test_mlp.py), and no seed's result depends on the others.
    """
    if deep.online.flat.device.type == "cpu":
        return one_by_one(deep, replay)
    return batched(deep, replay)


def batched(deep: DeepQ, replay: Replay) -> Update:
    """Stacked matrix products in torch."""
    online, target = deep.online, deep.target
    gradient = Networks(online.sizes, torch.zeros_like(online.flat))

    def update(places: NDArray, states: NDArray) -> tuple[NDArray, None]:
        batch = replay.sample(torch.from_numpy(places[0]).to(online.flat.device))
        next_values = target.forward(batch.next_state).add_(batch.next_base)
        y = torch.addcmul(batch.fixed, batch.discount, next_values.amax(-1))
        output = online.forward(batch.state)
        error = output.gather(-1, batch.action)[..., 0] - y
        # The loss is the mean over the batch and the sum over seeds.
        clipped = error.clamp(-1.0, 1.0)
        slope = torch.zeros_like(output)
        slope.scatter_(-1, batch.action, (clipped / error.shape[1])[..., None])
        online.backward(batch.state, slope, gradient)
        deep.optimiser.step(online.flat, gradient.flat)
        return (clipped * (error - 0.5 * clipped)).mean(1).cpu().numpy(), None

    return update


def one_by_one(deep: DeepQ, replay: Replay) -> Update:
    """One seed after the other in compiled code."""
    buffers = (deep.online.flat, deep.target.flat, deep.optimiser.moments)
    online, target, moments = (buffer.numpy() for buffer in buffers)
    sizes, layout = np.array(deep.online.sizes), (replay.d, replay.n_actions)
    kept = (replay.rows.numpy(), replay.bootstrap, replay.known)

    def update(places: NDArray, states: NDArray) -> tuple[NDArray, NDArray]:
        adam, loss = deep.optimiser.next_step(), np.empty(len(online))
        ahead = np.empty((len(online), replay.n_actions), np.float32)
        if len(places) > 1:
            compiled.renew_ahead(target, sizes, *kept, replay.size, places, layout)
        compiled.update(
            online,
            target,
            moments,
            sizes,
            *kept,
            places[0],
            layout,
            adam,
            states.astype(np.float32),
            loss,
            ahead,
        )
        return loss, ahead

    return update
