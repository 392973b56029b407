"""Q* of the car on the hill: exact search for the fewest steps to the goal.

A state has two successors a step and no two paths meet, so that a path of 26 steps
(mass 1.2) is one among 2^26. What makes the search small is an admissible bound: the
state space is cut into cells, each cell's one-step image is enclosed in a box, and the
steps from box to box until one meets the goal are never more than the true ones. The
search then follows only paths that can still arrive in time. Nothing is approximated:
the bound only discards, and every path found is one that `CarOnHill` drives.
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

ENV = CarOnHill
#: Cells along each axis; the finer cover is for where the coarser prunes too little.
COVERS = (500, 2000)
BUDGET = 20_000_000  # steps driven with one cover: about 20 s and 1 GiB
LONGEST = 2000  # steps after which a path counts as unresolved


def signed_steps(env: CarOnHill) -> NDArray[np.int64]:
    """Signed steps k of each evaluation state and action, shape (n, 2).

    k > 0: the fewest steps to the goal with this action first. k < 0: no path arrives,
    and |k| is the latest step at which the −1 comes. 0: no path arrives, but one stays
    clear for good (a heavy car in the valley). Depends on `env.mass` alone; kept on
    disk (`bcrl.evaluation.oracle.cache`). Raises BcrlError for a mass too hard to
    resolve.
    Source: Klink et al. (2022), C.1; Ernst, Geurts & Wehenkel (2005).
    """
    states = env.evaluation_states()
    return cache.cached(
        env.name,
        f"mass {float(env.mass).hex()}",
        [Path(module.__file__) for module in (hill, covers)] + [Path(__file__)],
        (len(states), env.n_actions),
        lambda: _solve(env, states),
    )


def values(steps: NDArray[np.int64], gamma: float) -> NDArray[np.float64]:
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


def _solve(env: CarOnHill, states: NDArray[np.float64]) -> NDArray[np.int64]:
    for cells in COVERS:
        steps = search(env, states, cover(env.mass, cells), BUDGET)
        if steps is not None:
            return steps
    raise BcrlError(
        f"env.mass={env.mass}: the search for Q* gave up (it is made for about 1 kg)"
    )


def search(
    env: CarOnHill, states: NDArray[np.float64], known: Cover, budget: int
) -> NDArray[np.int64] | None:
    """Signed steps (n, 2) of states (n, 2), or None beyond `budget` steps driven."""
    after, reward, absorbing = env.step(states[:, None], np.arange(env.n_actions))
    steps = reward.astype(np.int64).reshape(-1)  # ±1 where the first step decides
    start = after.reshape(-1, env.state_dim)
    open_ = np.flatnonzero(~absorbing)
    limit = known.bound[known.cell(start)].astype(np.int64)
    # Iterative deepening from the bound: the first limit that suffices is the least.
    waiting = open_[limit[open_] < FAR]
    never = open_[limit[open_] == FAR]
    while waiting.size:
        tried = _arrive(env, start, waiting, limit, known, budget)
        if tried is None:
            return None
        arrived, cut, budget = tried
        done = waiting[arrived[waiting]]
        steps[done] = 1 + limit[done]
        waiting = waiting[~arrived[waiting]]
        never = np.append(never, waiting[~cut[waiting]])
        waiting = waiting[cut[waiting]]
        limit[waiting] += 1
    latest = _survive(env, start, never, known, budget)
    if latest is None:
        return None
    steps[never] = np.where(latest[never] > 0, -1 - latest[never], 0)
    return steps.reshape(after.shape[:-1])


def _arrive(
    env: CarOnHill,
    start: NDArray[np.float64],
    pairs: NDArray[np.intp],
    limit: NDArray[np.int64],
    known: Cover,
    budget: int,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], int] | None:
    """Which `pairs` (rows of `start`) arrive within their `limit`, layer by layer.

    Also which had a path cut that may arrive later, and what is left of the budget.
    """
    arrived, cut = np.zeros((2, len(start)), dtype=np.bool_)
    state, pair, depth = start[pairs], pairs, 0
    while pair.size:
        budget -= 2 * pair.size
        if budget < 0:
            return None
        state, pair, reward, absorbing = _branch(env, state, pair)
        depth += 1
        arrived[pair[reward > 0.0]] = True
        going = ~(absorbing | arrived[pair])
        state, pair = state[going], pair[going]
        bound = known.bound[known.cell(state)]
        late = depth + bound > limit[pair]
        cut[pair[late & (bound < FAR)]] = True
        state, pair = state[~late], pair[~late]
    return arrived, cut, budget


def _survive(
    env: CarOnHill,
    start: NDArray[np.float64],
    pairs: NDArray[np.intp],
    known: Cover,
    budget: int,
) -> NDArray[np.int64] | None:
    """Latest step from `start` at which a lost pair's −1 can come; 0: it need not."""
    latest = np.zeros(len(start), dtype=np.int64)
    forever = np.zeros(len(start), dtype=np.bool_)
    state, pair, depth = start[pairs], pairs, 0
    while True:
        forever[pair[known.forever[known.cell(state)]]] = True
        going = ~forever[pair]
        state, pair = state[going], pair[going]
        if not pair.size:
            return np.where(forever, 0, latest)
        budget -= 2 * pair.size
        depth += 1
        if budget < 0 or depth > LONGEST:
            return None
        latest[pair] = depth
        state, pair, _, absorbing = _branch(env, state, pair)
        state, pair = state[~absorbing], pair[~absorbing]


def _branch(
    env: CarOnHill, state: NDArray[np.float64], pair: NDArray[np.intp]
) -> tuple[
    NDArray[np.float64], NDArray[np.intp], NDArray[np.float64], NDArray[np.bool_]
]:
    """Next states by both actions, the pairs that they belong to, reward, absorbing."""
    after, reward, absorbing = env.step(state[:, None], np.arange(env.n_actions))
    pairs = np.repeat(pair, env.n_actions)
    return after.reshape(-1, env.state_dim), pairs, reward.ravel(), absorbing.ravel()
