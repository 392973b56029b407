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
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bcrl.envs import car_on_hill as hill
from bcrl.envs.car_on_hill import CarOnHill
from bcrl.errors import BcrlError
from bcrl.evaluation.oracle import Reference, cache
from bcrl.evaluation.oracle import cover as covers
from bcrl.evaluation.oracle.cover import FAR, Cover, cover
from bcrl.learning import Booleans, Floats, Integers

ENV = CarOnHill
#: Cells along each axis; the finer cover is for masses where the coarser prunes little.
COVERS = (500, 2000)
BUDGET = 20_000_000  # steps driven with one cover: about 20 s and 1 GiB
LONGEST = 2000  # steps after which a path counts as unresolved


class _TooLong(Exception):
    """The budget is spent."""


def signed_steps(env: CarOnHill) -> NDArray[np.int64]:
    """Signed steps k of each evaluation state and action, shape (n, 2).

    k > 0: the fewest steps to the goal after this action. k < 0: no path arrives, and
    |k| is the latest step at which the −1 comes. 0: no path arrives, but one avoids the
    −1 forever (a heavy car in the valley). Depends on `env.mass` alone; cached on disk
    (`bcrl.evaluation.oracle.cache`). Raises BcrlError for a mass that takes too long.
    Source: Klink et al. (2022), C.1; Ernst, Geurts & Wehenkel (2005).
    """
    states = env.evaluation_states()
    sources = [Path(str(module.__file__)) for module in (hill, covers)]
    return cache.cached(
        f"{env.name}_{float(env.mass).hex()}",
        [*sources, Path(__file__)],
        lambda: _solve(env, states),
    )


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


def _solve(env: CarOnHill, states: Floats) -> NDArray[np.int64]:
    for cells in COVERS:
        steps = search(env, states, cover(env.mass, cells), BUDGET)
        if steps is not None:
            return steps
    why = "the search for Q* takes too long; choose a mass near 1 kg"
    raise BcrlError(f"env.mass={env.mass}: {why}, or leave q_error out of env.metrics")


def search(
    env: CarOnHill, states: Floats, known: Cover, budget: int
) -> NDArray[np.int64] | None:
    """Signed steps (n, 2) of states (n, 2), or None beyond `budget` steps driven."""
    try:
        return _Search(env, known, budget).signed_steps(states)
    except _TooLong:
        return None


class _Search:
    """Drives paths layer by layer, all paths of the same length together."""

    def __init__(self, env: CarOnHill, known: Cover, budget: int) -> None:
        self.env, self.known, self.budget = env, known, budget

    def signed_steps(self, states: Floats) -> NDArray[np.int64]:
        start, _, reward, absorbing = self._branch(states, np.arange(len(states)))
        steps = reward.astype(np.int64)  # ±1 where the first step decides
        limit = self.known.bound[self.known.cell(start)]
        waiting = np.flatnonzero(~absorbing & (limit < FAR))
        never = np.flatnonzero(~absorbing & (limit == FAR))
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
            bound = self.known.bound[self.known.cell(state)]
            late = depth + bound > limit[pair]
            cut[pair[late & (bound < FAR)]] = True
            state, pair = state[~late], pair[~late]
        return arrived, cut

    def _survive(self, start: Floats, pairs: Integers) -> NDArray[np.int64]:
        """The latest step at which a lost pair's −1 can come; 0: it can be avoided."""
        latest = np.zeros(len(start), dtype=np.int64)
        forever = np.zeros(len(start), dtype=np.bool_)
        state, pair, depth = start[pairs], pairs, 0
        while True:
            forever[pair[self.known.forever[self.known.cell(state)]]] = True
            state, pair = state[~forever[pair]], pair[~forever[pair]]
            if not pair.size:
                return np.where(forever, 0, latest)
            depth += 1
            if depth > LONGEST:
                raise _TooLong
            latest[pair] = depth
            state, pair, _, absorbing = self._branch(state, pair)
            state, pair = state[~absorbing], pair[~absorbing]

    def _branch(
        self, state: Floats, pair: Integers
    ) -> tuple[Floats, Integers, Floats, Booleans]:
        """Next states by both actions, the pairs they belong to, reward, absorbing."""
        self.budget -= 2 * pair.size
        if self.budget < 0:
            raise _TooLong
        n = self.env.n_actions
        after, reward, absorbing = self.env.step(state[:, None], np.arange(n))
        states = after.reshape(-1, self.env.state_dim)
        return states, np.repeat(pair, n), reward.ravel(), absorbing.ravel()
