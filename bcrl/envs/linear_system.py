"""A point mass under force control: an LQ task, and a narrow pathway with drift."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bcrl.common.arrays import like, namespace, ndtri
from bcrl.envs import _point_mass as point_mass
from bcrl.envs._point_mass import ACTION_COST, DT, GOAL_RADIUS, PATHWAY, START
from bcrl.envs.base import Step, check_episodes
from bcrl.errors import ConfigError, did_you_mean

WALLS = (-5.0, 1.0)  # x of the two reflecting walls (target task)
DIAGONAL = np.sqrt(0.5)
ACTIONS = np.array(
    [[1, 0], [0, 1], [-1, 0], [0, -1]]
    + [[a * DIAGONAL, b * DIAGONAL] for a in (1, -1) for b in (1, -1)]
)


class Constants(NamedTuple):
    """What the readings differ in: dynamics, and the half-width of the start's box."""

    gain: float
    friction: float
    spread: tuple[float, float, float, float]


#: preset → task → constants (paper, C.3; released code)
PRESETS = {
    "released": {
        "lq": Constants(2.0, 0.1, (0.3, 0.3, 0.3, 0.3)),
        "target": Constants(2.0, 1.0, (1e-3, 0.1, 0.4, 0.1)),
    },
    "paper": {
        "lq": Constants(1.0, 0.1, (0.0, 0.3, 0.0, 0.3)),
        "target": Constants(1.0, 0.1, (0.0, 0.1, 0.4, 0.1)),
    },
}


@dataclass(frozen=True)
class LinearSystem:
    """Push a point mass from x = −4 to the origin.

    | | |
    |---|---|
    | observation | (x, ẋ, y, ẏ), dimensionless |
    | actions | unit forces: 0–3 +x, +y, −x, −y; 4–7 (+,+), (+,−), (−,+), (−,−) |
    | dynamics | x' = ẋ, ẋ' = −friction ẋ + gain F_x, same for y; noise N(0, 1e-5²) on each derivative; Euler steps of 0.05 s |
    | `task=lq` | reward −s'ᵀ diag(3, 1, 3, 1) s' − 0.1 ‖F‖²; horizon 100; never absorbing |
    | `task=target` | `drift` is added to x'; walls at x = −5 and x = 1 reflect; (the drift may leave x outside by 0.02, where ẋ changes sign each step); whoever ends a step with \\|y\\| > 0.5 is put back to a fresh start (not absorbing); reward 0 and absorbing if ‖(x, y)‖ < 0.2, else −1; horizon 150 |
    | start | (−4, 0, 0, 0) plus a uniform draw from a box, see PRESETS |
    | source | Klink et al. (2022), §6.3 and C.3; released code for dt, walls, γ, horizons |

    `preset=released` (default) has gain 2, friction 0.1 in the LQ task and 1.0 in the
    target, `paper` gain 1 and friction 0.1 in both, and smaller start boxes. Runs on
    NumPy arrays and on torch tensors alike. Raises ConfigError for an unknown task or
    preset, γ outside [0, 1) or a horizon below 1.
    """  # noqa: E501

    task: str = "target"
    drift: float = -0.5
    gamma: float = 0.99
    horizon: int = 150
    preset: str = "released"

    name: ClassVar[str] = "linear_system"
    n_actions: ClassVar[int] = 8
    state_dim: ClassVar[int] = 4
    initial_noise: ClassVar[int] = 4
    step_noise: ClassVar[int] = 8  # four for the derivative, four for a fresh start
    actions: ClassVar[NDArray[np.float64]] = ACTIONS
    positions: ClassVar[tuple[int, ...]] = (0, 2)

    def __post_init__(self) -> None:
        for key, allowed in (("task", ("lq", "target")), ("preset", tuple(PRESETS))):
            value = getattr(self, key)
            if value not in allowed:
                raise ConfigError(f"env.{key}", value, did_you_mean(value, allowed))
        check_episodes(self.gamma, self.horizon)

    @property
    def constants(self) -> Constants:
        """Gain, friction and start box of this task in this preset."""
        return PRESETS[self.preset][self.task]

    @property
    def bounds(self) -> NDArray[np.float64]:
        """The lowest and the highest components of a state, (2, 4); some are infinite.

        Friction holds the velocities below what a unit force and noise of at most ten
        standard deviations keep up; the drift may lead beyond the walls by one step.
        """
        gain, friction, spread = self.constants
        noise = 10.0 * point_mass.NOISE
        fast = [max(spread[i], (gain + noise) / friction) for i in (1, 3)]
        if self.task == "lq":
            high = np.array([np.inf, fast[0], np.inf, fast[1]])
            return np.stack([-high, high])
        beyond = DT * (abs(self.drift) + noise)
        low = [WALLS[0] - beyond, -fast[0], -PATHWAY, -fast[1]]
        return np.array([low, [WALLS[1] + beyond, fast[0], PATHWAY, fast[1]]])

    @property
    def linear_quadratic(self) -> tuple[NDArray[np.float64], ...] | None:
        """A, B, Q, R of s' = A s + B F, reward −s'ᵀ Q s' − Fᵀ R F; None if not so."""
        if self.task != "lq":
            return None
        gain, friction, _ = self.constants
        drift = np.kron(np.eye(2), np.array([[0.0, 1.0], [0.0, -friction]]))
        push = np.kron(np.eye(2), np.array([[0.0], [gain]]))
        return (
            np.eye(4) + DT * drift,
            DT * push,
            np.diag(point_mass.STATE_COST),
            ACTION_COST * np.eye(2),
        )

    @cached_property
    def _dynamics(self) -> point_mass.Dynamics:
        gain, friction, _ = self.constants
        if self.task == "lq":
            return point_mass.Dynamics(gain, friction, 0.0, -np.inf, np.inf)
        return point_mass.Dynamics(gain, friction, self.drift, *WALLS)

    @cached_property
    def _for_lanes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Start box and dynamics as arrays."""
        return np.array(self.constants.spread), np.array(self._dynamics)

    def initial(self, noise: NDArray[np.float64]) -> NDArray[np.float64]:
        """Start states (..., 4): the box around (−4, 0, 0, 0), for noise (..., 4)."""
        found = point_mass.start(_components(noise), self.constants.spread)
        return namespace(noise).stack(found, -1)

    def step(
        self,
        state: NDArray[np.float64],
        action: NDArray[np.integer],
        noise: NDArray[np.float64],
    ) -> Step:
        """One step with action (...), an index into `actions`."""
        return self.push(state, like(ACTIONS, state)[action], noise)

    def push(
        self,
        state: NDArray[np.float64],
        force: NDArray[np.float64],
        noise: NDArray[np.float64],
    ) -> Step:
        """One step with any force (..., 2); the fresh start, if any, is in `noise`."""
        xp = namespace(state)
        normal, uniform = ndtri(noise[..., :4]), noise[..., 4:]
        if xp is np:
            spread, dynamics = self._for_lanes
            if self.task == "target":
                return point_mass.pathway_lanes(
                    state, force, normal, uniform, spread, dynamics
                )
            after, reward = point_mass.lq_lanes(state, force, normal, dynamics)
            return after, reward, np.zeros_like(reward, bool)
        moved = self._moved(state, force, normal)
        if self.task == "lq":
            reward = point_mass.lq_reward(moved, _components(force))
            return xp.stack(moved, -1), reward, xp.zeros_like(reward, dtype=bool)
        fresh = point_mass.start(_components(uniform), self.constants.spread)
        after, reward, arrived = point_mass.pathway(xp.where, moved, fresh)
        return xp.stack(after, -1), reward, arrived

    def before_reset(
        self,
        state: NDArray[np.float64],
        action: NDArray[np.integer],
        noise: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Where `step` leads before a fresh start replaces it, (..., 4)."""
        force, normal = like(ACTIONS, state)[action], ndtri(noise[..., :4])
        if namespace(state) is np:
            return point_mass.motion_lanes(state, force, normal, self._for_lanes[1])
        return namespace(state).stack(self._moved(state, force, normal), -1)

    def _moved(self, state: Any, force: Any, normal: Any) -> tuple[Any, ...]:
        """`point_mass.motion` on whole tensors."""
        parts = map(_components, (state, force, normal))
        return point_mass.motion(namespace(state).where, *parts, self._dynamics)

    def evaluation_states(self) -> NDArray[np.float64]:
        """(−4, 0, 0, 0) and the corners of half the target's start box, (17, 4).

        The same in both tasks, so that FQI's curves go on from one to the other.
        """
        half = 0.5 * np.array(PRESETS[self.preset]["target"].spread)
        signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 4, indexing="ij"), -1)
        return np.array(START) + half * np.vstack(
            [np.zeros((1, 4)), signs.reshape(-1, 4)]
        )

    def plane(self, side: int = 41, extent: float = 5.0) -> NDArray[np.float64]:
        """The x–y plane [−extent, extent]² at zero velocity, x-major, (side², 4)."""
        axis = np.linspace(-extent, extent, side)
        states = np.zeros((side, side, 4))
        states[..., 0], states[..., 2] = np.meshgrid(axis, axis, indexing="ij")
        return states.reshape(-1, 4)

    def scene(self) -> dict[str, NDArray[np.float64]]:
        """What a figure needs to draw the task: forces, pathway, goal, start, drift."""
        half = np.array(self.constants.spread)[[0, 2]]
        at = np.array(START)[[0, 2]]
        return {
            "actions": ACTIONS,
            "pathway": np.array([WALLS[0], -PATHWAY, WALLS[1], PATHWAY]),
            "goal": np.array([0.0, 0.0, GOAL_RADIUS]),
            "start": np.concatenate([at - half, at + half]),
            "drift": np.array([self.drift, 0.0]),
        }


def _components(array: Any) -> tuple[Any, ...]:
    """The entries of the last axis, each an array of the leading axes."""
    return tuple(array[..., i] for i in range(array.shape[-1]))


ENV = LinearSystem
