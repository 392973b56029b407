"""Q* of the car on the hill: exact search for the fewest steps to the goal.

Each state has two successors and no two paths join, so a path of 26 steps (mass 1.2) is
one of 2^26. An admissible bound keeps the search small: the state space is cut into
cells, each cell's one-step image lies in a box, and the number of steps from box to box
until one touches the goal is never more than the true one. The search follows only
paths that can still arrive in time. It is exact: the bound only discards, and every
path found is one that `CarOnHill` drives.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bcrl.envs import car_on_hill as hill
from bcrl.envs.car_on_hill import MAX_POSITION, MAX_SPEED, CarOnHill
from bcrl.errors import BcrlError
from bcrl.evaluation.oracle import Reference, cache
from bcrl.learning import Booleans, Floats, Integers

ENV = CarOnHill
#: Cells along each axis; the finer cover is for masses where the coarser prunes little.
COVERS = (500, 2000)
BUDGET = 20_000_000  # steps driven with one cover: about 20 s and 1 GiB
_LONGEST = 2000  # steps after which a path counts as unresolved
#: Box margin beyond the corners' images, in cells. A cell's image bends away from its
#: corners' hull by less than a third of a cell: where paths cross p = 0 the flow's
#: gradient jumps by up to |v| = 3 /s, elsewhere the flow is smooth.
_MARGIN = 0.5
_FAR = 32767  # bound of a cell from which the goal is out of reach
_LIMITS = np.array([MAX_POSITION, MAX_SPEED])


def signed_steps(env: CarOnHill) -> NDArray[np.int64]:
    """Signed steps k of each evaluation state and action, shape (n, 2).

    k > 0: the fewest steps to the goal after this action. k < 0: no path arrives, and
    |k| is the latest step at which the −1 comes. 0: no path arrives, but one avoids the
    −1 forever (a heavy car in the valley). Depends on `env.mass` alone; cached on disk
    (`bcrl.evaluation.oracle.cache`). Raises BcrlError for a mass that takes too long.
    Source: Klink et al. (2022), C.1; Ernst, Geurts & Wehenkel (2005).
    """

    def solve() -> NDArray[np.int64]:
        for cells in COVERS:
            try:
                return Search(env, *cover(env.mass, cells), BUDGET).signed_steps(states)
            except TooLong:
                continue
        why = "the search for Q* takes too long; choose a mass near 1 kg"
        why += ", or leave q_error out of env.metrics"
        raise BcrlError(f"env.mass={env.mass}: {why}")

    states, sources = (
        env.evaluation_states(),
        [Path(str(hill.__file__)), Path(__file__)],
    )
    return cache.cached(f"{env.name}_{float(env.mass).hex()}", sources, solve)


def values(steps: NDArray[np.int64], gamma: float) -> Floats:
    """Q* = sign(k) γ^(|k| − 1) of signed steps k, 0 for k = 0."""
    return np.sign(steps) * gamma ** np.maximum(abs(steps) - 1, 0)


def reference(env: CarOnHill) -> Reference:
    """Q* on the grid of evaluation states."""
    return Reference(env.evaluation_states(), values(signed_steps(env), env.gamma))


def table(env: CarOnHill) -> Iterator[str]:
    """CSV lines, actions (as forces) outermost, then the grid position-major."""
    yield "position,velocity,action,signed_steps,q"
    steps = signed_steps(env)
    q = values(steps, env.gamma)
    for action, force in enumerate((-hill.FORCE, hill.FORCE)):
        for row, (p, v) in enumerate(env.evaluation_states()):
            k = steps[row, action]
            yield f"{p:.17g},{v:.17g},{force:g},{k},{q[row, action]:.17g}"


def cover(mass: float, cells: int) -> tuple[NDArray[np.int64], Booleans]:
    """`bound` and `forever` of cells × cells cells, position-major.

    `bound`: at least so many steps to the goal, `_FAR` where it is out of reach.
    `forever`: whether every state in the cell can avoid absorption forever.
    """
    low, high = image_boxes(mass, cells)
    slow = (high[..., 1] >= -MAX_SPEED) & (low[..., 1] <= MAX_SPEED)
    goal = slow & (high[..., 0] > MAX_POSITION)
    alive = slow & (high[..., 0] >= -MAX_POSITION) & (low[..., 0] <= MAX_POSITION)
    safe = ((low >= -_LIMITS) & (high <= _LIMITS)).all(-1)
    first, last = _cell(low, cells), _cell(high, cells) + 1
    # A cell is one step further from the goal than the nearest cell it may reach.
    bound, steps = np.where(goal.any(0), 1, _FAR), 1
    while (bound == steps).any():
        reaches = alive & (_count(bound <= steps, first, last) > 0)
        steps += 1
        bound[reaches.any(0) & (bound == _FAR)] = steps
    # Drop cells until the box of each one left has an action that stays among them.
    area, forever = (last - first).prod(-1), np.ones((cells, cells), bool)
    while True:
        stays = (safe & (_count(forever, first, last) == area)).any(0) & forever
        if (stays == forever).all():
            return bound, forever
        forever = stays


def image_boxes(mass: float, cells: int) -> tuple[Floats, Floats]:
    """Lower and upper corners of boxes around each cell's image, (2, cells, cells, 2).

    The leading axis is the action.
    """
    axes = [np.linspace(-limit, limit, cells + 1) for limit in _LIMITS]
    corners = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    env, margin = CarOnHill(mass=mass), _MARGIN * 2.0 * _LIMITS / cells
    low, high = np.empty((2, 2, cells, cells, 2))
    for action in (0, 1):
        image, _, _ = env.step(corners, np.full(corners.shape[:2], action))
        four = image[:-1, :-1], image[1:, :-1], image[:-1, 1:], image[1:, 1:]
        low[action] = np.minimum.reduce(four) - margin
        high[action] = np.maximum.reduce(four) + margin
    return low, high


def _cell(state: Floats, cells: int) -> NDArray[np.int64]:
    """Row and column (..., 2) of the cell of, or nearest to, states (..., 2)."""
    scaled = np.nan_to_num((state / _LIMITS + 1.0) * (cells / 2))
    return np.clip(scaled, 0, cells - 1).astype(np.int64)


def _count(marked: Booleans, low: NDArray, high: NDArray) -> NDArray[np.int64]:
    """Marked cells in boxes of cells, from `low` (..., 2) to before `high`."""
    total = np.pad(marked.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    (i, j), (k, m) = np.moveaxis(low, -1, 0), np.moveaxis(high, -1, 0)
    return total[k, m] - total[i, m] - total[k, j] + total[i, j]


class TooLong(Exception):
    """The search has spent its budget."""


@dataclass
class Search:
    """Drives paths layer by layer, all paths of the same length together."""

    env: CarOnHill
    bound: NDArray[np.int64]  # of each cell, see `cover`
    forever: Booleans  # of each cell
    budget: int  # steps that may still be driven

    def signed_steps(self, states: Floats) -> NDArray[np.int64]:
        """Signed steps (n, 2) of states (n, 2); TooLong beyond the budget."""
        start, _, reward, absorbing = self._branch(states, np.arange(len(states)))
        steps = reward.astype(np.int64)  # ±1 where the first step decides
        limit = self._of(self.bound, start)
        waiting = np.flatnonzero(~absorbing & (limit < _FAR))
        never = np.flatnonzero(~absorbing & (limit == _FAR))
        # Iterative deepening from the bound: the first limit that suffices is least.
        while waiting.size:
            arrived, cut = self._arrive(start, waiting, limit)
            done = arrived[waiting]
            steps[waiting[done]] = 1 + limit[waiting[done]]
            never = np.append(never, waiting[~done & ~cut[waiting]])
            waiting = waiting[~done & cut[waiting]]
            limit[waiting] += 1
        latest = self._survive(start, never)
        steps[never] = np.where(latest[never] > 0, -1 - latest[never], 0)
        return steps.reshape(len(states), self.env.n_actions)

    def _arrive(
        self, start: Floats, pairs: Integers, limit: NDArray[np.int64]
    ) -> tuple[Booleans, Booleans]:
        """Which `pairs` (rows of `start`) arrive within their `limit`.

        Also which of them had a path cut that may arrive later.
        """
        arrived, cut = np.zeros((2, len(start)), dtype=np.bool_)
        state, pair, depth = start[pairs], pairs, 0
        while pair.size:
            state, pair, reward, absorbing = self._branch(state, pair)
            depth += 1
            arrived[pair[reward > 0.0]] = True
            going = ~(absorbing | arrived[pair])
            state, pair = state[going], pair[going]
            bound = self._of(self.bound, state)
            late = depth + bound > limit[pair]
            cut[pair[late & (bound < _FAR)]] = True
            state, pair = state[~late], pair[~late]
        return arrived, cut

    def _survive(self, start: Floats, pairs: Integers) -> NDArray[np.int64]:
        """The latest step at which a lost pair's −1 can come; 0: it can be avoided."""
        latest, forever = np.zeros(len(start), np.int64), np.zeros(len(start), bool)
        state, pair, depth = start[pairs], pairs, 0
        while True:
            forever[pair[self._of(self.forever, state)]] = True
            state, pair = state[~forever[pair]], pair[~forever[pair]]
            if not pair.size:
                return np.where(forever, 0, latest)
            depth += 1
            if depth > _LONGEST:
                raise TooLong
            latest[pair] = depth
            state, pair, _, absorbing = self._branch(state, pair)
            state, pair = state[~absorbing], pair[~absorbing]

    def _branch(
        self, state: Floats, pair: Integers
    ) -> tuple[Floats, Integers, Floats, Booleans]:
        """Next states by both actions, the pairs they belong to, reward, absorbing."""
        self.budget -= 2 * pair.size
        if self.budget < 0:
            raise TooLong
        n = self.env.n_actions
        after, reward, absorbing = self.env.step(state[:, None], np.arange(n))
        states = after.reshape(-1, self.env.state_dim)
        return states, np.repeat(pair, n), reward.ravel(), absorbing.ravel()

    def _of(self, cells: NDArray, state: Floats) -> NDArray:
        """The entries of `cells` for the cells of states (n, 2)."""
        return cells[tuple(_cell(state, len(cells)).T)]
