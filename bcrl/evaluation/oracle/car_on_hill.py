"""Q* of the car on the hill: exact search for the fewest steps to the goal.

Each state has two successors and no two paths join, so a path of 26 steps (mass 1.2) is
one of 2^26. An admissible bound keeps the search small: the state space is cut into
cells, each cell's one-step image lies in a box, and the number of steps from box to box
until one touches the goal is never more than the true one. The search follows only
paths that can still arrive in time. It is exact: the bound only discards, and every
path found is one that `CarOnHill` drives.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from bcrl.envs.car_on_hill import FORCE, MAX_POSITION, MAX_SPEED, CarOnHill
from bcrl.errors import BcrlError
from bcrl.learning import Booleans, Floats, Integers

ENV = CarOnHill
CELLS = 200  # along each axis
_LARGEST = 500_000  # paths followed together: a few hundred MiB
#: Box margin beyond the corners' images, in cells. A cell's image bends away from its
#: corners' hull by less than a third of a cell: where paths cross p = 0 the flow's
#: gradient jumps by up to |v| = 3 /s, elsewhere the flow is smooth.
_MARGIN = 0.5
_LIMITS = np.array([MAX_POSITION, MAX_SPEED])


def signed_steps(env: CarOnHill) -> NDArray[np.int64]:
    """Signed steps k of each evaluation state and action, shape (n, 2).

    k > 0: the fewest steps to the goal after this action. k < 0: no path arrives, and
    |k| is the latest step at which the −1 comes. Depends on `env.mass` alone. Raises
    BcrlError for a mass that takes too long, as one that stays in the valley forever.
    Source: Klink et al. (2022), C.1; Ernst, Geurts & Wehenkel (2005).
    """
    states, bound = env.evaluation_states(), least_steps(env.mass)
    start, pair, reward, absorbing = _branch(env, states, np.arange(len(states)))
    steps = reward.astype(np.int64)  # ±1 where the first step decides
    limit = bound[_cells(start)]
    pair = np.flatnonzero(~absorbing)
    # Iterative deepening from the bound: the first limit that suffices is least.
    while pair.size:
        arrived, cut, longest = _drive(env, bound, start[pair], limit[pair])
        steps[pair] = np.where(arrived, 1 + limit[pair], -1 - longest)
        decided = arrived | np.isinf(limit[pair])
        limit[pair] += np.where(cut, 1, np.inf)
        pair = pair[~decided]
    return steps.reshape(len(states), env.n_actions)


def _drive(
    env: CarOnHill, bound: Floats, state: Floats, limit: Floats
) -> tuple[Booleans, Booleans, Integers]:
    """All paths from n states, each for as long as it can arrive within its limit.

    Returns where one arrives, where one was cut that may arrive later, and the number
    of steps of the longest path.
    """
    arrived, cut = np.zeros((2, len(state)), dtype=np.bool_)
    longest, pair, depth = np.zeros(len(state), np.intp), np.arange(len(state)), 0
    while pair.size:
        depth += 1
        longest[pair] = depth
        state, pair, reward, absorbing = _branch(env, state, pair)
        arrived[pair[reward > 0.0]] = True
        going = ~(absorbing | arrived[pair])
        state, pair = state[going], pair[going]
        least = bound[_cells(state)]
        late = depth + least > limit[pair]
        cut[pair[late & np.isfinite(least)]] = True
        state, pair = state[~late], pair[~late]
    return arrived, cut, longest


def _branch(
    env: CarOnHill, state: Floats, pair: Integers
) -> tuple[Floats, Integers, Floats, Booleans]:
    """Next states by both actions, the pairs they belong to, reward, absorbing."""
    if pair.size > _LARGEST:
        why = "Q* takes too long to find; choose a mass near 1 kg, or no metric q_error"
        raise BcrlError(f"env.mass={env.mass}: {why}")
    after, reward, absorbing = env.step(state[:, None], np.arange(env.n_actions))
    pairs = np.repeat(pair, env.n_actions)
    return after.reshape(-1, env.state_dim), pairs, reward.ravel(), absorbing.ravel()


def least_steps(mass: float) -> Floats:
    """At least so many steps lead from each cell to the goal; infinite if none do."""
    low, high = image_boxes(mass)
    slow = (high[..., 1] >= -MAX_SPEED) & (low[..., 1] <= MAX_SPEED)
    goal = slow & (high[..., 0] > MAX_POSITION)
    alive = slow & (high[..., 0] >= -MAX_POSITION) & (low[..., 0] <= MAX_POSITION)
    (top, left), (bottom, right) = _cells(low), (i + 1 for i in _cells(high))
    # A cell is one step further from the goal than the nearest cell it may reach.
    bound, steps = np.where(goal.any(0), 1.0, np.inf), 1
    while (bound == steps).any():
        sums = np.pad((bound <= steps).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
        marked = sums[bottom, right] - sums[top, right]  # cells in each box
        marked += sums[top, left] - sums[bottom, left]
        steps += 1
        bound[(alive & (marked > 0)).any(0) & np.isinf(bound)] = steps
    return bound


def image_boxes(mass: float) -> tuple[Floats, Floats]:
    """Corners of boxes around each cell's image by action, (2, CELLS, CELLS, 2)."""
    axes = [np.linspace(-limit, limit, CELLS + 1) for limit in _LIMITS]
    corners = np.stack(np.meshgrid(*axes, indexing="ij"), -1)[:, :, None]
    image, _, _ = CarOnHill(mass=mass).step(corners, np.arange(2))
    image = np.moveaxis(image, 2, 0)
    four = image[:, :-1, :-1], image[:, 1:, :-1], image[:, :-1, 1:], image[:, 1:, 1:]
    margin = _MARGIN * 2.0 * _LIMITS / CELLS
    return np.minimum.reduce(four) - margin, np.maximum.reduce(four) + margin


def _cells(state: Floats) -> tuple[Integers, ...]:
    """Rows and columns of the cells of, or nearest to, states (..., 2)."""
    scaled = np.nan_to_num((state / _LIMITS + 1.0) * (CELLS / 2))
    return tuple(np.moveaxis(np.clip(scaled, 0, CELLS - 1).astype(np.intp), -1, 0))


def reference(env: CarOnHill) -> tuple[Floats, Floats]:
    """The grid of evaluation states (n, 2), and Q* = sign(k) γ^(|k| − 1) (n, 2)."""
    return env.evaluation_states(), _values(env, signed_steps(env))


def _values(env: CarOnHill, steps: Integers) -> Floats:
    """Q* of signed steps."""
    return np.sign(steps) * env.gamma ** (abs(steps) - 1)


def table(env: CarOnHill) -> Iterator[str]:
    """CSV lines, actions (as forces) outermost, then the grid position-major."""
    yield "position,velocity,action,signed_steps,q"
    states, steps = env.evaluation_states(), signed_steps(env)
    actions = zip((-FORCE, FORCE), steps.T, _values(env, steps).T, strict=True)
    for force, ks, qs in actions:
        for (p, v), k, q in zip(states, ks, qs, strict=True):
            yield f"{p:.17g},{v:.17g},{force:g},{k},{q:.17g}"
