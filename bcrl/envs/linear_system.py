"""A point mass under force control: an LQ task, and a narrow pathway with drift."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bcrl.common.arrays import ndtri, writable
from bcrl.common.checks import one_of
from bcrl.common.compiling import kept
from bcrl.envs.base import Floats, Ints, Step, check_episodes

DT = 0.05  # s, Euler step
NOISE = 1e-5  # standard deviation of the noise on each component of the derivative
WALLS = (-5.0, 1.0)  # x of the two reflecting walls (target task)
PATHWAY = 0.5  # |y| beyond which the target task starts anew
_GOAL_RADIUS = 0.2  # distance to the origin that counts as success
_START = np.array([-4.0, 0.0, 0.0, 0.0])
STATE_COST = (3.0, 1.0, 3.0, 1.0)  # diagonal, LQ task
ACTION_COST = 0.1  # per squared unit of force, LQ task
_DIAGONAL = np.sqrt(0.5) * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
ACTIONS = np.vstack([[[1, 0], [0, 1], [-1, 0], [0, -1]], _DIAGONAL])
#: Preset, task → gain, friction, half-widths of the start's box (C.3; released code)
_PRESETS = {
    ("released", "lq"): (2.0, 0.1, (0.3, 0.3, 0.3, 0.3)),
    ("released", "target"): (2.0, 1.0, (1e-3, 0.1, 0.4, 0.1)),
    ("paper", "lq"): (1.0, 0.1, (0.0, 0.3, 0.0, 0.3)),
    ("paper", "target"): (1.0, 0.1, (0.0, 0.1, 0.4, 0.1)),
}


@dataclass(frozen=True)
class LinearSystem:
    """Push a point mass from x = −4 to the origin.

    | | |
    |---|---|
    | observation | (x, ẋ, y, ẏ), dimensionless; unbounded, but see `bounds` |
    | actions | unit forces: 0–3 +x, +y, −x, −y; 4–7 (+,+), (+,−), (−,+), (−,−) |
    | dynamics | x' = ẋ, ẋ' = −friction ẋ + gain F_x, same for y; noise N(0, 1e-5²) on each derivative; Euler steps of 0.05 s |
    | `task=lq` | reward −s'ᵀ diag(3, 1, 3, 1) s' − 0.1 ‖F‖²; horizon 100; never absorbing |
    | `task=target` | `drift` is added to x'; walls at x = −5 and x = 1 reflect (the drift may push x beyond by 0.02, where ẋ changes sign each step); a step that ends with \\|y\\| > 0.5 leads to a fresh start (not absorbing); reward 0 and absorbing if ‖(x, y)‖ < 0.2, else −1; horizon 150 |
    | start | (−4, 0, 0, 0) plus a uniform draw from a box, see `constants` |
    | source | Klink et al. (2022), §6.3 and C.3; released code for dt, walls, γ, horizons |

    `preset=released` (default) has gain 2, friction 0.1 in the LQ task and 1.0 in the
    target, `paper` gain 1 and friction 0.1 in both, and smaller start boxes. Raises
    ConfigError for an unknown task or preset, γ outside [0, 1) or a horizon below 1.
    """  # noqa: E501

    task: str = "target"
    drift: float = -0.5
    gamma: float = 0.99
    horizon: int = 150
    preset: str = "released"

    name, n_actions, state_dim = "linear_system", 8, 4
    components = ("x", "ẋ", "y", "ẏ")  # of the state
    initial_noise, step_noise = 4, 8  # four for the derivative, four for a fresh start
    actions, positions = ACTIONS, (0, 2)

    def __post_init__(self) -> None:
        one_of("env.task", self.task, ("lq", "target"))
        one_of("env.preset", self.preset, ("released", "paper"))
        check_episodes(self.gamma, self.horizon)

    @property
    def constants(self) -> tuple[float, float, tuple[float, ...]]:
        """Gain, friction and half-widths of the start box, by task and preset."""
        return _PRESETS[self.preset, self.task]

    @property
    def bounds(self) -> Floats:
        """The lowest and the highest components of a state, (2, 4); some are infinite.

        Friction holds the velocities below the one that a unit force and noise of ten
        standard deviations sustain; the drift may lead beyond the walls by one step.
        """
        gain, friction, spread = self.constants
        fast = [max(spread[i], (gain + 10.0 * NOISE) / friction) for i in (1, 3)]
        high = np.array([np.inf, fast[0], np.inf, fast[1]])
        found = np.stack([-high, high])
        if self.task == "target":
            beyond = DT * (abs(self.drift) + 10.0 * NOISE)
            found[:, 0] = WALLS[0] - beyond, WALLS[1] + beyond
            found[:, 2] = -PATHWAY, PATHWAY
        return found

    @property
    def linear_quadratic(self) -> tuple[Floats, ...] | None:
        """A, B, Q, R of s' = A s + B F, reward −s'ᵀ Q s' − Fᵀ R F; None if not so."""
        if self.task != "lq":
            return None
        gain, friction, _ = self.constants
        a = np.kron(np.eye(2), np.array([[1.0, DT], [0.0, 1.0 - DT * friction]]))
        b = np.kron(np.eye(2), np.array([[0.0], [DT * gain]]))
        return a, b, np.diag(STATE_COST), ACTION_COST * np.eye(2)

    @property
    def _dynamics(self) -> tuple[float, ...]:
        """Gain, friction, drift and the walls' x."""
        free, narrow = (0.0, -np.inf, np.inf), (self.drift, *WALLS)
        return *self.constants[:2], *(free if self.task == "lq" else narrow)

    def initial(self, noise: Floats) -> Floats:
        """Start states (..., 4): the box around (−4, 0, 0, 0), for noise (..., 4)."""
        return _START + np.array(self.constants[2]) * (2.0 * noise - 1.0)

    def step(self, state: Floats, action: Ints, noise: Floats) -> Step:
        """One step with action (...), an index into `actions`."""
        return self.push(state, ACTIONS[action], noise)

    def push(self, state: Floats, force: Floats, noise: Floats) -> Step:
        """One step with any force (..., 2); the fresh start, if any, is in `noise`."""
        lead, rows = _rows(state, force, ndtri(noise[..., :4]), noise)
        task = self.constants[2], self.task == "lq"
        after, reward, arrived = _push(*rows, self._dynamics, *task)
        return after.reshape(*lead, 4), reward.reshape(lead), arrived.reshape(lead)

    def before_reset(self, state: Floats, action: Ints, noise: Floats) -> Floats:
        """Where `step` leads before a fresh start replaces it, (..., 4)."""
        lead, rows = _rows(state, ACTIONS[action], ndtri(noise[..., :4]))
        return _moved(*rows, self._dynamics).reshape(*lead, 4)

    def evaluation_states(self) -> Floats:
        """(−4, 0, 0, 0) and the corners of half the target's start box, (17, 4)."""
        half = 0.5 * np.array(_PRESETS[self.preset, "target"][2])
        signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 4, indexing="ij"), -1)
        return _START + half * np.vstack([np.zeros((1, 4)), signs.reshape(-1, 4)])

    def plane(self) -> Floats:
        """The x–y plane [−5, 5]² at zero velocity, x-major, (41², 4)."""
        axis, states = np.linspace(-5.0, 5.0, 41), np.zeros((41, 41, 4))
        states[..., 0], states[..., 2] = np.meshgrid(axis, axis, indexing="ij")
        return states.reshape(-1, 4)

    def scene(self) -> dict[str, Floats]:
        """What a figure needs to draw the task: forces, pathway, goal, start, drift."""
        at, half = _START[[0, 2]], np.array(self.constants[2])[[0, 2]]
        return {
            "actions": ACTIONS,
            "pathway": np.array([WALLS[0], -PATHWAY, WALLS[1], PATHWAY]),
            "goal": np.array([0.0, 0.0, _GOAL_RADIUS]),
            "start": np.concatenate([at - half, at + half]),
            "drift": np.array([self.drift, 0.0]),
        }


def _rows(*arrays: Floats) -> tuple[tuple[int, ...], list[Floats]]:
    """The arrays' common leading axes, and each array as rows (n, k) over them."""
    lead, *others = (array.shape[:-1] for array in arrays)
    if others.count(lead) < len(others):  # rare; it takes longer than a step
        lead = np.broadcast_shapes(lead, *others)
        arrays = tuple(np.broadcast_to(a, (*lead, a.shape[-1])) for a in arrays)
    return lead, [writable(a).reshape(-1, a.shape[-1]) for a in arrays]


@kept(nogil=True)
def _moved(state: Any, force: Any, normal: Any, dynamics: Any) -> Any:
    """States (n, 4) after one step: integrated, then reflected by the walls."""
    after = np.empty_like(state)
    gain, friction, drift, low, high = dynamics
    for i in range(len(state)):
        x, x_dot, y, y_dot = state[i]
        push, z = force[i], normal[i]
        new_x = x + DT * (x_dot + drift + NOISE * z[0])
        new_x_dot = x_dot + DT * (gain * push[0] - friction * x_dot + NOISE * z[1])
        new_y = y + DT * (y_dot + NOISE * z[2])
        new_y_dot = y_dot + DT * (gain * push[1] - friction * y_dot + NOISE * z[3])
        if new_x < low or new_x > high:
            # A straight line to the contact, then without force and drift. Where the
            # drift overcame the velocity, mirroring leads outside by a little: share 0.
            span = 1.0 if new_x == x else new_x - x
            share = ((low if new_x < low else high) - x) / span
            share = 0.0 if share < 0.0 else 1.0 if share > 1.0 else share
            rest = (1.0 - share) * DT
            x_dot_there = -(x_dot + share * (new_x_dot - x_dot))
            y_dot_there = y_dot + share * (new_y_dot - y_dot)
            new_x = x + share * (new_x - x) + rest * x_dot_there
            new_x_dot = x_dot_there - rest * friction * x_dot_there
            new_y = y + share * (new_y - y) + rest * y_dot_there
            new_y_dot = y_dot_there - rest * friction * y_dot_there
        after[i, 0], after[i, 1] = new_x, new_x_dot
        after[i, 2], after[i, 3] = new_y, new_y_dot
    return after


@kept(nogil=True)
def _push(
    state: Any, force: Any, normal: Any, noise: Any, dynamics: Any, spread: Any, lq: Any
) -> Any:
    """Next states, rewards and ends; `noise` gives the target task's fresh starts."""
    after, reward = _moved(state, force, normal, dynamics), np.empty(len(state))
    arrived = np.zeros(len(state), np.bool_)
    for i in range(len(state)):
        if lq:
            cost = ACTION_COST * (force[i, 0] * force[i, 0] + force[i, 1] * force[i, 1])
            for k in range(4):
                cost = cost + STATE_COST[k] * after[i, k] * after[i, k]
            reward[i] = -cost
            continue
        if after[i, 2] > PATHWAY or after[i, 2] < -PATHWAY:
            for k in range(4):  # as `initial`
                after[i, k] = _START[k] + spread[k] * (2.0 * noise[i, 4 + k] - 1.0)
        distance = after[i, 0] * after[i, 0] + after[i, 2] * after[i, 2]
        arrived[i] = distance < _GOAL_RADIUS * _GOAL_RADIUS
        reward[i] = 0.0 if arrived[i] else -1.0
    return after, reward, arrived


ENV = LinearSystem
