"""Our environments behind Gymnasium's interface."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from bcrl.common.checks import construct
from bcrl.envs import Env, env_class
from bcrl.envs.rendering import draw, frames_per_second
from bcrl.errors import ConfigError

UNBOUNDED = float(np.finfo(np.float32).max)  # Gymnasium warns of infinite bounds


class GymEnv(gymnasium.Env):
    """One task behind Gymnasium's interface.

    `env` is an environment of the `Env` protocol, or the name of one with its
    `constants`. Observations are its states, as they are (float64); `terminated` says
    absorbed; that episodes are cut is up to Gymnasium's `max_episode_steps`. `info`
    says after a step whether the episode `is_success`: absorbed without a punishment.
    Raises ConfigError for unknown names, constants and values.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self, env: Env | str, render_mode: str | None = None, **constants: Any
    ) -> None:
        self.task, self.render_mode = _task(env, constants), _mode(render_mode)
        self.metadata = self.metadata | {"render_fps": frames_per_second(self.task)}
        self.observation_space = _observations(self.task)
        self.action_space = Discrete(self.task.n_actions)
        self._state = np.zeros(self.task.state_dim)
        self._path: list[NDArray[np.float64]] = []  # so far, if there are pictures

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """A start state; with a `seed`, the same one each time."""
        super().reset(seed=seed)
        noise = self.np_random.random(self.task.initial_noise)
        self._path = []
        return self._arrived(self.task.initial(noise)), {}

    def step(
        self, action: int
    ) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """One step; ValueError for what is no action."""
        if not self.action_space.contains(action):
            raise ValueError(f"{action!r} is no action of {self.action_space}")
        noise = self.np_random.random(self.task.step_noise)
        after, reward, absorbing = self.task.step(self._state, np.int64(action), noise)
        success = {"is_success": bool(absorbing and reward >= 0.0)}
        return self._arrived(after), float(reward), bool(absorbing), False, success

    def _arrived(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Note the state, and give the observation of it."""
        self._state = state
        if self.render_mode:
            self._path.append(state)
        return state.copy()

    def render(self) -> NDArray[np.uint8] | None:
        """A picture of the episode so far, (400, 400, 3), if asked to make some."""
        if self.render_mode is None:
            return None
        step = len(self._path) - 1
        return draw(self.task, np.stack(self._path), caption=f"step {step}")


class GymVectorEnv(VectorEnv):
    """`num_envs` episodes of one task side by side, each step one call on arrays.

    Draws the same numbers as a SyncVectorEnv of `GymEnv`s: each episode has its own
    generator, and the step after its last one resets it. Pictures are without the past.
    """

    metadata = GymEnv.metadata | {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        env: Env | str,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        **constants: Any,
    ) -> None:
        self.task, self.render_mode = _task(env, constants), _mode(render_mode)
        self.num_envs = num_envs
        self.single_observation_space = _observations(self.task)
        self.single_action_space = Discrete(self.task.n_actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._limit = np.inf if max_episode_steps is None else max_episode_steps
        self._rngs: list[np.random.Generator | None] = [None] * num_envs
        self._state = np.zeros((num_envs, self.task.state_dim))
        self._steps = np.zeros(num_envs, np.intp)
        self._over = np.zeros(num_envs, bool)

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Start states (num_envs, d); of `options`, `reset_mask` is known."""
        if not isinstance(seed, list):
            seed = [seed if seed is None else seed + i for i in range(self.num_envs)]
        lanes = (options or {}).get("reset_mask", np.ones(self.num_envs, bool))
        for i in np.flatnonzero(lanes):
            if seed[i] is not None or self._rngs[i] is None:
                self._rngs[i], _ = seeding.np_random(seed[i])
        self._begin(lanes)
        return self._state.copy(), {}

    def step(self, actions: NDArray[np.integer]) -> tuple[Any, ...]:
        """One step of each episode, or its start anew; ValueError for no actions."""
        if not self.action_space.contains(actions):
            raise ValueError(f"{actions!r} are no actions of {self.action_space}")
        fresh, lanes = self._over, ~self._over
        reward, terminated = np.zeros(self.num_envs), np.zeros(self.num_envs, bool)
        self._state[lanes], reward[lanes], terminated[lanes] = self.task.step(
            self._state[lanes],
            actions[lanes],
            self._noise(lanes, self.task.step_noise),
        )
        self._steps[lanes] += 1
        truncated = lanes & (self._steps >= self._limit)
        self._begin(fresh)
        self._over = terminated | truncated
        success = {"is_success": terminated & (reward >= 0.0), "_is_success": lanes}
        info = success if lanes.any() else {}
        return self._state.copy(), reward, terminated, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture of each episode's present state."""
        if self.render_mode is None:
            return None
        now = zip(self._state[:, None], self._steps, strict=True)
        return tuple(draw(self.task, s, caption=f"step {t}") for s, t in now)

    def _begin(self, lanes: NDArray[np.bool_]) -> None:
        noise = self._noise(lanes, self.task.initial_noise)
        self._state[lanes] = self.task.initial(noise)
        self._steps[lanes], self._over[lanes] = 0, False

    def _noise(self, lanes: NDArray[np.bool_], count: int) -> NDArray[np.float64]:
        """`count` uniforms from each of the lanes' generators."""
        chosen = np.flatnonzero(lanes)
        noise = np.empty((len(chosen), count))
        for row, lane in zip(noise, chosen if count else (), strict=count > 0):
            row[:] = self._rngs[lane].random(count)
        return noise


def _task(env: Env | str, constants: dict[str, Any]) -> Env:
    """The environment called `env`, with constants; another than a name as it is."""
    if not isinstance(env, str):
        if constants:
            raise TypeError(f"{env} has its constants; not taken: {sorted(constants)}")
        return env
    if "horizon" in constants:
        why = "an episode's length is Gymnasium's max_episode_steps"
        raise ConfigError("env.horizon", constants["horizon"], why)
    for key, value in constants.items():
        if isinstance(value, np.generic):  # a number out of an array
            constants[key] = value.item()
    return construct("env", env_class(env), constants)


def _mode(render_mode: str | None) -> str | None:
    if render_mode not in (None, *GymEnv.metadata["render_modes"]):
        raise ConfigError("render_mode", render_mode, "must be rgb_array or None")
    return render_mode


def _observations(task: Env) -> Box:
    """The box of the states, as large as can be in what the task's `bounds` leave."""
    everything = np.array([[-np.inf], [np.inf]]).repeat(task.state_dim, 1)
    low, high = np.clip(getattr(task, "bounds", everything), -UNBOUNDED, UNBOUNDED)
    return Box(low, high, dtype=np.float64)
