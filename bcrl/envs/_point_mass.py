"""The point mass's dynamics, component by component: one source for lanes and tensors.

With a scalar `where` numba compiles these functions for one lane at a time, and `lanes`
runs them over NumPy arrays; with torch's they run on tensors as they are.
"""

from __future__ import annotations

from typing import NamedTuple

import numba

from bcrl.common.arrays import per_lane

DT = 0.05  # s, Euler step
NOISE = 1e-5  # standard deviation of the noise on each component of the derivative
PATHWAY = 0.5  # |y| beyond which the target task starts anew
GOAL_RADIUS = 0.2  # distance to the origin that counts as success
START = (-4.0, 0.0, 0.0, 0.0)
STATE_COST = (3.0, 1.0, 3.0, 1.0)  # diagonal, LQ task
ACTION_COST = 0.1  # per squared unit of force, LQ task


class Dynamics(NamedTuple):
    """What the motion depends on; without walls `low` and `high` are infinite."""

    gain: float
    friction: float
    drift: float  # added to dx/dt
    low: float  # x of the reflecting walls
    high: float


@numba.njit
def _choose(condition, a, b):
    """`where` for one lane."""
    return a if condition else b


def motion(where, state, force, normal, dynamics):
    """Where the components (x, ẋ, y, ẏ) are after one step: integrated, reflected."""
    x, x_dot, y, y_dot = state
    gain, friction, drift, low, high = dynamics
    new_x = x + DT * (x_dot + drift + NOISE * normal[0])
    new_x_dot = x_dot + DT * (gain * force[0] - friction * x_dot + NOISE * normal[1])
    new_y = y + DT * (y_dot + NOISE * normal[2])
    new_y_dot = y_dot + DT * (gain * force[1] - friction * y_dot + NOISE * normal[3])
    # Up to the contact in a straight line, then on without force and drift. Where
    # the drift overcame the velocity, mirroring leads outside by a little: share 0.
    beyond = (new_x < low) | (new_x > high)
    span = where(new_x == x, 1.0, new_x - x)
    share = (where(new_x < low, low, high) - x) / span
    share = where(share < 0.0, 0.0, where(share > 1.0, 1.0, share))
    rest = (1.0 - share) * DT
    x_dot_there = -(x_dot + share * (new_x_dot - x_dot))
    y_dot_there = y_dot + share * (new_y_dot - y_dot)
    x_there, y_there = x + share * (new_x - x), y + share * (new_y - y)
    return (
        where(beyond, x_there + rest * x_dot_there, new_x),
        where(beyond, x_dot_there - rest * friction * x_dot_there, new_x_dot),
        where(beyond, y_there + rest * y_dot_there, new_y),
        where(beyond, y_dot_there - rest * friction * y_dot_there, new_y_dot),
    )


def start(uniform, spread):
    """A start state's components, from uniforms, in the box of half-widths `spread`."""
    return (
        START[0] + spread[0] * (2.0 * uniform[0] - 1.0),
        START[1] + spread[1] * (2.0 * uniform[1] - 1.0),
        START[2] + spread[2] * (2.0 * uniform[2] - 1.0),
        START[3] + spread[3] * (2.0 * uniform[3] - 1.0),
    )


def lq_reward(state, force):
    """What the LQ task gives for the new state's components and the force's."""
    cost = ACTION_COST * (force[0] * force[0] + force[1] * force[1])
    for i in range(4):
        cost = cost + STATE_COST[i] * state[i] * state[i]
    return -cost


def pathway(where, moved, fresh):
    """The target task's next state, reward and end; `fresh`: a start's components."""
    fell = (moved[2] > PATHWAY) | (moved[2] < -PATHWAY)
    x, x_dot = where(fell, fresh[0], moved[0]), where(fell, fresh[1], moved[1])
    y, y_dot = where(fell, fresh[2], moved[2]), where(fell, fresh[3], moved[3])
    arrived = x * x + y * y < GOAL_RADIUS * GOAL_RADIUS
    return (x, x_dot, y, y_dot), where(arrived, 0.0, -1.0), arrived


_motion, _start, _lq_reward, _pathway = map(
    numba.njit, (motion, start, lq_reward, pathway)
)


@numba.njit
def _moved(state, force, normal, d):
    components = (state[0], state[1], state[2], state[3])
    return _motion(_choose, components, force, normal, (d[0], d[1], d[2], d[3], d[4]))


@per_lane("(f8[:], f8[:], f8[:], f8[:], f8[:])", "(s),(k),(s),(c)->(s)")
def motion_lanes(state, force, normal, dynamics, after):
    """`motion` on arrays: state (..., 4), force (..., 2), normal (..., 4)."""
    after[0], after[1], after[2], after[3] = _moved(state, force, normal, dynamics)


@per_lane("(f8[:], f8[:], f8[:], f8[:], f8[:], f8[:])", "(s),(k),(s),(c)->(s),()")
def lq_lanes(state, force, normal, dynamics, after, reward):
    """The LQ task's next state and reward on arrays."""
    moved = _moved(state, force, normal, dynamics)
    after[0], after[1], after[2], after[3] = moved
    reward[0] = _lq_reward(moved, force)


@per_lane(
    "(f8[:], f8[:], f8[:], f8[:], f8[:], f8[:], f8[:], f8[:], b1[:])",
    "(s),(k),(s),(s),(s),(c)->(s),(),()",
)
def pathway_lanes(
    state, force, normal, uniform, spread, dynamics, after, reward, arrived
):
    """The target task's step on arrays; a fresh start is from `uniform` (..., 4)."""
    fresh = _start(uniform, spread)
    moved = _moved(state, force, normal, dynamics)
    found, reward[0], arrived[0] = _pathway(_choose, moved, fresh)
    after[0], after[1], after[2], after[3] = found
