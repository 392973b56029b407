"""The maze with two walls and an ever narrower passage (paper, §6.2 and C.2)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bcrl.common.checks import one_of
from bcrl.envs.base import Bools, Floats, Ints, Step, check_episodes
from bcrl.errors import ConfigError

SIDE = 21  # lattice points along each axis
MOVE = 0.05  # length of a move, 1 / (SIDE - 1)
WALL_X = (0.2, 0.6)  # wall centres; the first stands on y = 0, the second hangs from 1
GOAL = np.array([0.95, 0.95])
GOAL_RADIUS = 0.1  # L1 distance
GOAL_REWARD = 5.0
MOVES = MOVE * np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
ROUNDING = 1e-9  # far below the lattice spacing, far above float error

#: preset → wall half-width, bound of the goal's radius, are positions on the lattice
PRESETS = {
    "lattice": (0.05, GOAL_RADIUS + ROUNDING, True),
    "paper": (0.025, GOAL_RADIUS - ROUNDING, True),
    "released": (0.05, GOAL_RADIUS, False),
}


@dataclass(frozen=True)
class Maze:
    """Walk from (0, 0) to (0.95, 0.95) around two walls.

    | | |
    |---|---|
    | observation | (x, y) in [0, 1]², dimensionless; on a 21 × 21 lattice |
    | actions | 0: x − 0.05, 1: x + 0.05, 2: y − 0.05, 3: y + 0.05 |
    | dynamics | s' = clip(s + move, 0, 1); s' = s if that lies inside a wall |
    | walls | \\|x − 0.2\\| < w and y < h; \\|x − 0.6\\| < w and y > 1 − h (strictly) |
    | reward | 5 at the goal, else −‖s' − (0.95, 0.95)‖₁ of the new state |
    | absorbing | ‖s' − (0.95, 0.95)‖₁ ≤ 0.1 |
    | start | (0, 0); episodes are cut after 200 steps |
    | source | Klink et al. (2022), §6.2 and C.2; released code for w = 0.05 |

    `height` is the task parameter h. `preset` names three readings of the constants:
    `lattice` (default) compares exact lattice positions, w = 0.05; `paper` takes the
    text literally, goal distance < 0.1 and w = 0.025; `released` adds up the moves in
    floating point with w = 0.05 and goal distance < 0.1, as the authors' code does, so
    on a boundary the path decides which side a position is on. Raises ConfigError for
    a height or γ outside [0, 1), an unknown preset or a horizon below 1.
    """

    height: float = 0.95
    gamma: float = 0.99
    horizon: int = 200
    preset: str = "lattice"

    name, n_actions, state_dim = "maze", 4, 2
    components = ("x", "y")  # of the state
    initial_noise, step_noise = 0, 0
    actions, goal = MOVES, GOAL
    bounds = np.array([[0.0, 0.0], [1.0, 1.0]])  # of the states

    def __post_init__(self) -> None:
        if not 0.0 <= self.height < 1.0:
            raise ConfigError("env.height", self.height, "must lie in [0, 1)")
        one_of("env.preset", self.preset, PRESETS)
        check_episodes(self.gamma, self.horizon)

    @property
    def finite(self) -> bool:
        """Whether positions stay on the lattice, so that Q can be tabulated."""
        return PRESETS[self.preset][2]

    @property
    def walls(self) -> Floats:
        """Both walls as rectangles (x0, y0, x1, y1), shape (2, 4)."""
        w = PRESETS[self.preset][0]
        (a, b), h = WALL_X, self.height
        return np.array([[a - w, 0.0, a + w, h], [b - w, 1.0 - h, b + w, 1.0]])

    def blocked(self, state: Floats) -> Bools:
        """Whether states (..., 2) lie strictly inside a wall, shape (...)."""
        half_width, _, on_lattice = PRESETS[self.preset]
        slack = ROUNDING if on_lattice else 0.0
        x, y = state[..., 0], state[..., 1]
        first, second = (abs(x - wall) < half_width - slack for wall in WALL_X)
        stands, hangs = y < self.height - slack, y > 1.0 - self.height + slack
        return (first & stands) | (second & hangs)

    def is_goal(self, state: Floats) -> Bools:
        """Whether states (..., 2) lie at the goal, shape (...)."""
        return abs(state - GOAL).sum(-1) < PRESETS[self.preset][1]

    def initial(self, noise: Floats) -> Floats:
        """The corner (0, 0) for noise of shape (..., 0)."""
        return np.zeros((*noise.shape[:-1], 2))

    def step(self, state: Floats, action: Ints, noise: Floats | None = None) -> Step:
        """One move; see the class docstring."""
        moved = np.clip(state + MOVES[action], 0.0, 1.0)
        if self.finite:
            moved = np.rint(moved * (SIDE - 1)) / (SIDE - 1)
        moved = np.where(self.blocked(moved)[..., None], state, moved)
        at_goal = self.is_goal(moved)
        reward = np.where(at_goal, GOAL_REWARD, -abs(moved - GOAL).sum(-1))
        return moved, reward, at_goal

    def evaluation_states(self) -> Floats:
        """The start state, shape (1, 2)."""
        return np.zeros((1, 2))

    def states(self) -> Floats:
        """The lattice, x-major, shape (441, 2)."""
        axis = np.arange(SIDE) / (SIDE - 1)
        return np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)

    def index(self, state: Floats) -> NDArray[np.intp]:
        """Row of the nearest lattice point of each state (..., 2)."""
        cell = np.rint(np.asarray(state) * (SIDE - 1)).astype(np.intp)
        return cell[..., 0] * SIDE + cell[..., 1]


ENV = Maze
