"""Environments whose tasks can be altered: rewards, actions and goals."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bcrl.api import CarOnHill, LinearSystem, Maze
from bcrl.envs.base import Floats, Ints, Step, check_episodes
from bcrl.envs.car_on_hill import MAX_POSITION, MAX_SPEED
from bcrl.envs.linear_system import ACTIONS
from bcrl.envs.maze import GOAL_REWARD, PRESETS

GOAL_RADIUS = 0.2  # of the point mass


@dataclass(frozen=True)
class Altered:
    """Changes of a task, for a class that also inherits from an environment.

    Action a executes action `order[a]`. With `irrelevant`, the reward is the cosine of
    three times the sum of s', which has nothing to do with the goal; episodes still end
    there. The reward is multiplied by `scale`, then `shift` is added at every step.
    """

    order: tuple[int, ...] = ()
    irrelevant: bool = False
    scale: float = 1.0
    shift: float = 0.0

    def step(self, state: Floats, action: Ints, noise: Floats | None = None) -> Step:
        """The step of the environment with its action and reward altered."""
        environment: Any = super()
        return self.judged(*environment.step(state, self.executed(action), noise))

    def executed(self, action: Ints) -> Ints:
        """The actions that are executed instead of `action` (...)."""
        return np.array(self.order)[action] if self.order else action

    def judged(self, after: Floats, reward: Floats, absorbing: Any) -> Step:
        """The step with its reward altered."""
        if self.irrelevant:
            reward = np.cos(3.0 * after.sum(-1))
        return after, self.scale * reward + self.shift, absorbing


@dataclass(frozen=True)
class Hill(Altered, CarOnHill):
    """The car on the hill; `goal_left` rewards the left end and punishes the right."""

    goal_left: bool = False

    def judged(self, after: Floats, reward: Floats, absorbing: Any) -> Step:
        """The step with the goal at its end."""
        if self.goal_left:
            p, v = after[..., 0], after[..., 1]
            there = (p < -MAX_POSITION) & (abs(v) <= MAX_SPEED) & (reward != 0.0)
            lost = (reward != 0.0) & ~there
            reward = 1.0 * there - 1.0 * lost
        return super().judged(after, reward, absorbing)


@dataclass(frozen=True)
class Lattice(Altered, Maze):
    """The maze with its goal at any lattice point `goal`."""

    goal: tuple[float, float] = (0.95, 0.95)  # type: ignore[assignment]

    def is_goal(self, state: Floats) -> Any:
        """Whether states (..., 2) lie at the goal, shape (...)."""
        return abs(state - self.goal).sum(-1) < PRESETS[self.preset][1]

    def judged(self, after: Floats, reward: Floats, absorbing: Any) -> Step:
        """The step with the rewards of its own goal."""
        distance = abs(after - self.goal).sum(-1)
        reward = np.where(absorbing, GOAL_REWARD, -distance)
        return super().judged(after, reward, absorbing)


@dataclass(frozen=True)
class PointMass(Altered, LinearSystem):
    """The point mass; in the task `target`, the goal can lie at any (x, y)."""

    goal: tuple[float, float] = (0.0, 0.0)

    def step(self, state: Floats, action: Ints, noise: Floats | None = None) -> Step:
        """One step with action (...); `push` alters the reward."""
        assert noise is not None
        return self.push(state, ACTIONS[self.executed(action)], noise)

    def push(self, state: Floats, force: Floats, noise: Floats) -> Step:
        """One step with any force (..., 2)."""
        after, reward, absorbing = super().push(state, force, noise)
        if self.task == "target":
            x, y = self.goal
            absorbing = np.hypot(after[..., 0] - x, after[..., 2] - y) < GOAL_RADIUS
            reward = np.where(absorbing, 0.0, -1.0)
        return self.judged(after, reward, absorbing)


_LOW, _HIGH = np.array([-1.2, -0.07]), np.array([0.6, 0.07])


@dataclass(frozen=True)
class _Car:
    """Gymnasium's MountainCar-v0 with observations rescaled to [−1, 1].

    Reward −1 per step. An episode ends at the goal: at the right from 0.5 on, or, with
    `goal_left`, at the left wall.
    """

    force: float = 0.001  # m/step²
    goal_left: bool = False
    gamma: float = 0.99
    horizon: int = 200

    name, n_actions, state_dim = "mountain_car", 3, 2
    initial_noise, step_noise, success = 1, 0, "absorbed"
    actions = np.array([[-1.0], [0.0], [1.0]])

    def __post_init__(self) -> None:
        check_episodes(self.gamma, self.horizon)

    def initial(self, noise: Floats) -> Floats:
        """At rest at a position between −0.6 and −0.4, for noise (..., 1)."""
        start = np.concatenate([-0.6 + 0.2 * noise, 0.0 * noise], -1)
        return self._observed(start)

    def _observed(self, hidden: Floats) -> Floats:
        return 2.0 * (hidden - _LOW) / (_HIGH - _LOW) - 1.0

    def step(self, state: Floats, action: Ints, noise: Floats | None = None) -> Step:
        """One step of the car."""
        hidden = _LOW + 0.5 * (state + 1.0) * (_HIGH - _LOW)
        position, velocity = hidden[..., 0], hidden[..., 1]
        pull = (action - 1.0) * self.force - 0.0025 * np.cos(3.0 * position)
        velocity = np.clip(velocity + pull, _LOW[1], _HIGH[1])
        position = np.clip(position + velocity, _LOW[0], _HIGH[0])
        at_wall = position == _LOW[0]
        velocity = np.where(at_wall, np.maximum(velocity, 0.0), velocity)
        arrived = at_wall if self.goal_left else position >= 0.5
        after = self._observed(np.stack([position, velocity], -1))
        return after, np.full(position.shape, -1.0), arrived

    def evaluation_states(self) -> Floats:
        """Ten starts, evenly spaced, (10, 2)."""
        return self.initial((np.arange(10.0)[:, None] + 0.5) / 10)


@dataclass(frozen=True)
class MountainCar(Altered, _Car):
    """The mountain car whose task can be altered."""
