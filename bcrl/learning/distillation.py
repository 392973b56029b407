"""Distillation: one network learns the values of a sum, to take its place."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from bcrl.common.seeding import stream
from bcrl.learning import Floats
from bcrl.learning.folding import Folded
from bcrl.learning.replay import Replay
from bcrl.learning.transfer import StageResult
from bcrl.q.networks import distil
from bcrl.q.networks.cpu import outputs
from bcrl.q.networks.mlp import Adam, DeepQ, Networks, xavier

RATE, BATCH = 3e-3, 64  # of Adam; the rate falls to a hundredth of it in a round
#: Updates of the first round; each of ROUNDS rounds has twice those of the one before.
ROUND, ROUNDS = 4000, 3


class Distilled(NamedTuple):
    """The network of one seed."""

    flat: NDArray[np.float32]  # (P,)
    values: Floats  # (n, A) its outputs
    error: float  # root mean square in `_Units`


def distilled(
    sizes: tuple[int, ...],
    states: Floats,
    values: Floats,
    limit: float,
    seed: int,
    stage: int,
) -> Distilled:
    """A network with nearly these values (n, A) at states (n, d).

    It stops after the first round whose error is at most `limit`.
    """
    rng = stream(seed, "distillation", stage)
    flat, units = xavier(rng, sizes), _Units.of(states, values)
    x, y = units.inputs(states), units.outputs(values)
    moments, done = np.zeros((2, len(flat)), np.float32), 0
    best, widths = Distilled(flat, values, np.inf), np.array(sizes)
    seen = states[None].astype(np.float32)
    for k in range(ROUNDS):
        n = ROUND * 2**k
        indices = rng.integers(len(states), size=(n, BATCH))
        rates = RATE * np.geomspace(1.0, 0.01, n)
        distil.descend(flat, moments, widths, x, y, indices, rates, done)
        own, done = units.plain(flat, sizes), done + n
        found = outputs(own[None], widths, seen)[0].astype(float)
        error = float(np.sqrt(np.mean((units.outputs(found) - y) ** 2.0)))
        best = min(best, Distilled(own, found, error), key=lambda one: one.error)
        if best.error <= limit:
            break
    return best


class _Units(NamedTuple):
    """Inputs by their means and spreads; outputs by those of V and of advantages.

    V is the mean over the actions. The advantages, Q − V, decide about actions, but are
    small beside V. y = m + σ_V z̄ + σ_A (z − z̄) with z̄ the mean over the actions.
    """

    mean: Floats  # (d,)
    scale: Floats  # (d,)
    value: float  # m
    value_scale: float  # σ_V
    advantage_scale: float  # σ_A

    @classmethod
    def of(cls, states: Floats, values: Floats) -> "_Units":
        v = values.mean(1)
        spreads = (x.std() for x in (v, values - v[:, None]))
        scale = np.where(states.std(0) > 0, states.std(0), 1.0)
        return cls(states.mean(0), scale, v.mean(), *(x or 1.0 for x in spreads))

    def inputs(self, states: Floats) -> NDArray[np.float32]:
        return ((states - self.mean) / self.scale).astype(np.float32)

    def outputs(self, values: Floats) -> NDArray[np.float32]:
        v = values.mean(1, keepdims=True)
        scaled = (v - self.value) / self.value_scale
        return (scaled + (values - v) / self.advantage_scale).astype(np.float32)

    def plain(self, flat: NDArray, sizes: tuple[int, ...]) -> NDArray[np.float32]:
        """The network that does to plain numbers what `flat` does to those in units."""
        own = torch.from_numpy(flat.astype(np.float64))[None]
        layers = Networks(sizes, own).layers  # views of `own`
        weights, biases = layers[0]
        weights /= torch.from_numpy(self.scale)[:, None]
        biases -= torch.from_numpy(self.mean) @ weights
        mix = self.advantage_scale * np.eye(n := sizes[-1])
        mix += (self.value_scale - self.advantage_scale) / n
        for part in layers[-1]:
            part.copy_(part @ torch.from_numpy(mix))
        layers[-1][1].add_(self.value)
        found: NDArray[np.float32] = own[0].numpy().astype(np.float32)
        return found


def fold(
    result: StageResult,
    deep: DeepQ,
    replay: Replay,
    limit: float,
    seeds: Sequence[int],
    stage: int,
) -> tuple[StageResult, Folded]:
    """The result with one network like `deep` for Q, distilled at the replay's states.

    Also returns how Q changed there, with a note where the error exceeds `limit`.
    """
    states = replay.rows[:, : replay.size, : replay.d].cpu().double().numpy()
    stacked: Any = states  # of equally many states each
    values = [np.asarray(x) for x in result.q(stacked, replay.n_actions)]
    sizes, notes = deep.online.sizes, []
    found = [
        distilled(sizes, x, y, limit, seed, stage)
        for x, y, seed in zip(states, values, seeds, strict=True)
    ]
    for one in found:
        why = f"the error is {one.error:.3g}, more than boosting.fold_loss={limit}"
        notes.append("" if one.error <= limit else why)
    folded = Folded.of(deep, values, [one.values for one in found], notes)
    flat = torch.from_numpy(np.stack([one.flat for one in found]))
    online = Networks(sizes, flat.to(deep.online.flat.device))
    target = Networks(sizes, online.flat.clone())
    q = DeepQ(online, target, Adam.of(online.flat, deep.optimiser.rate))
    acting = result.acting and replace(result.acting, own=q)
    return StageResult(q, q, acting=acting), folded
