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
from bcrl.q.networks.units import InUnits

RATE, BATCH = 3e-3, 64  # of Adam; the rate falls to a hundredth of it in a round
#: Updates of the first round; each of ROUNDS rounds has twice those of the one before.
ROUND, ROUNDS = 4000, 3


class Distilled(NamedTuple):
    """The network of one seed."""

    flat: NDArray[np.float32]  # (P,)
    values: Floats  # (n, A) Q by it
    error: float  # root mean square, in the units of V and of advantages


def distilled(
    units: InUnits,
    s: int,
    states: Floats,
    values: Floats,
    limit: float,
    seed: int,
    stage: int,
) -> Distilled:
    """A network with nearly these values (n, A) at states (n, d) in the units of s.

    It stops after the first round whose error is at most `limit`. Its inputs are
    standardised while it learns.
    """
    rng, sizes = stream(seed, "distillation", stage), units.deep.online.sizes
    flat, widths = xavier(rng, sizes), np.array(sizes)
    middle, scale = states.mean(0), states.std(0)
    scale = np.where(scale > 0.0, scale, 1.0)
    x = ((states - middle) / scale).astype(np.float32)
    y, seen = units.in_units(s, values), states[None].astype(np.float32)
    moments, done = np.zeros((2, len(flat)), np.float32), 0
    best = Distilled(flat, values, np.inf)
    for k in range(ROUNDS):
        n = ROUND * 2**k
        indices = rng.integers(len(states), size=(n, BATCH))
        rates = RATE * np.geomspace(1.0, 0.01, n)
        known = (x, y.astype(np.float32), indices, rates, done)
        distil.descend(flat, moments, widths, *known)
        own, done = _of_plain_inputs(flat, sizes, middle, scale), done + n
        z = outputs(own[None], widths, seen)[0].astype(float)
        error = float(np.sqrt(np.mean((z - y) ** 2)))
        found = Distilled(own, units.plain(s, z), error)
        best = min(best, found, key=lambda one: one.error)
        if best.error <= limit:
            break
    return best


def _of_plain_inputs(
    flat: NDArray, sizes: tuple[int, ...], middle: Floats, scale: Floats
) -> NDArray[np.float32]:
    """The network that does to inputs what `flat` does to standardised ones."""
    own = torch.from_numpy(flat.astype(np.float64))[None]
    weights, biases = Networks(sizes, own).layers[0]  # views of `own`
    weights /= torch.from_numpy(scale)[:, None]
    biases -= torch.from_numpy(middle) @ weights
    found: NDArray[np.float32] = own[0].numpy().astype(np.float32)
    return found


def units_of(deep: DeepQ, values: Sequence[Floats]) -> InUnits:
    """The units of S seeds' values (n, A): mean and spread of V, spread of Q − V."""
    v = [x.mean(1) for x in values]
    spreads = np.array(
        [
            (own.std(), (x - own[:, None]).std())
            for own, x in zip(v, values, strict=True)
        ]
    )
    spreads = np.where(spreads > 0.0, spreads, 1.0)
    means = np.array([own.mean() for own in v])
    return InUnits(deep, means, spreads[:, 0], spreads[:, 1])


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
    sizes, notes, units = deep.online.sizes, [], units_of(deep, values)
    found = [
        distilled(units, s, x, y, limit, seed, stage)
        for s, (x, y, seed) in enumerate(zip(states, values, seeds, strict=True))
    ]
    for one in found:
        why = f"the error is {one.error:.3g}, more than boosting.fold_loss={limit}"
        notes.append("" if one.error <= limit else why)
    folded = Folded.of(deep, values, [one.values for one in found], notes)
    flat = torch.from_numpy(np.stack([one.flat for one in found]))
    online = Networks(sizes, flat.to(deep.online.flat.device))
    target = Networks(sizes, online.flat.clone())
    made = DeepQ(online, target, Adam.of(online.flat, deep.optimiser.rate))
    q = replace(units, deep=made)
    acting = result.acting and replace(result.acting, own=q)
    return StageResult(q, q, acting=acting), folded
