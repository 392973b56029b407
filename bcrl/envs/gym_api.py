"""Our environments behind Gymnasium's interface."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from bcrl.common.checks import construct
from bcrl.envs import Env, env_class
from bcrl.envs.base import Bools, Floats, Ints
from bcrl.envs.checks import LARGEST
from bcrl.envs.rendering import draw, frames_per_second
from bcrl.errors import ConfigError


class GymEnv(gymnasium.Env):
    """One task behind Gymnasium's interface.

    `env` is an environment of the `Env` protocol, or the name of one with its `given`
    constants. Observations are its states in float64; `terminated` means absorbing.
    `info["is_success"]` says whether a step was absorbed without a negative reward.
    Raises ConfigError for unknown names, constants and values.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, env: Env | str, render_mode: Any = None, **given: Any) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError("render_mode", render_mode, "must be rgb_array or None")
        self.task, self.render_mode = _task(env, given), render_mode
        self.metadata = self.metadata | {"render_fps": frames_per_second(self.task)}
        everything = np.array([[-np.inf], [np.inf]]).repeat(self.task.state_dim, 1)
        bounds = getattr(self.task, "bounds", everything)
        low, high = np.clip(
            bounds, -LARGEST, LARGEST
        )  # Gymnasium warns of infinite ones
        self.observation_space = Box(low, high, dtype=np.float64)
        self.action_space = Discrete(self.task.n_actions)
        self._path: list[Floats] = []  # the episode's states

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict]:
        """A start state; with a `seed`, the same one each time."""
        super().reset(seed=seed)
        noise = self.np_random.random(self.task.initial_noise)
        self._path = [self.task.initial(noise)]
        return self._path[-1].copy(), {}

    def step(self, action: int) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """One step; ValueError for an action outside the space."""
        if not self.action_space.contains(action):
            raise ValueError(f"{action!r} is no action of {self.action_space}")
        noise, number = self.np_random.random(self.task.step_noise), np.asarray(action)
        after, reward, absorbing = self.task.step(self._path[-1], number, noise)
        self._path = [*(self._path if self.render_mode else ()), after]
        info = {"is_success": bool(absorbing and reward >= 0.0)}
        return after.copy(), float(reward), bool(absorbing), False, info

    def render(self) -> Any:
        """A picture of the episode so far, (400, 400, 3); None without a mode."""
        if self.render_mode is None:
            return None
        caption = f"step {len(self._path) - 1}"
        return draw(self.task, np.stack(self._path), caption=caption)


class GymVectorEnv(VectorEnv):
    """`num_envs` of `GymEnv` in one call, with the numbers of a SyncVectorEnv."""

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        env: Env | str,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        **given: Any,
    ) -> None:
        if (mode := given.pop("render_mode", None)) is not None:
            raise ConfigError("render_mode", mode, "must be None: it draws no pictures")
        one = GymEnv(env, **given)
        self.task, self.num_envs = one.task, num_envs
        self.single_observation_space = one.observation_space
        self.single_action_space = one.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._limit = np.inf if max_episode_steps is None else max_episode_steps
        self._rngs = [np.random.default_rng() for _ in range(num_envs)]
        self._state = np.zeros((num_envs, self.task.state_dim))
        self._steps = np.zeros(num_envs, np.intp)
        self._over = np.zeros(num_envs, bool)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Floats, dict]:
        """Start states (num_envs, d); `seed` is a number, a list of them, or None."""
        if isinstance(seed, (int, np.integer)):
            seed = [seed + i for i in range(self.num_envs)]
        for i, own in enumerate(seed or ()):
            if own is not None:
                self._rngs[i], _ = seeding.np_random(own)
        self._begin(np.ones(self.num_envs, bool))
        return self._state.copy(), {}

    def step(self, actions: Ints) -> tuple[Any, ...]:
        """One step of each episode, or its new start; ValueError for wrong actions."""
        if not self.action_space.contains(actions):
            raise ValueError(f"{actions!r} are no actions of {self.action_space}")
        lanes, n = ~self._over, self.num_envs
        reward, terminated = np.zeros(n), np.zeros(n, bool)
        noise = self._noise(lanes, self.task.step_noise)
        found = self.task.step(self._state[lanes], actions[lanes], noise)
        self._state[lanes], reward[lanes], terminated[lanes] = found
        self._steps[lanes] += 1
        self._begin(~lanes)
        truncated = lanes & (self._steps >= self._limit)
        self._over = terminated | truncated
        success = {"is_success": terminated & (reward >= 0.0), "_is_success": lanes}
        info = success if lanes.any() else {}
        return self._state.copy(), reward, terminated, truncated, info

    def _begin(self, lanes: Bools) -> None:
        noise = self._noise(lanes, self.task.initial_noise)
        self._state[lanes], self._steps[lanes] = self.task.initial(noise), 0
        self._over[lanes] = False

    def _noise(self, lanes: Bools, count: int) -> Floats:
        """`count` uniforms from the generator of each chosen lane."""
        drawn = [self._rngs[lane].random(count) for lane in np.flatnonzero(lanes)]
        return np.array(drawn).reshape(len(drawn), count)


def _task(env: Env | str, given: dict[str, Any]) -> Env:
    """The environment called `env` with given constants; `env` itself if it is one."""
    if not isinstance(env, str):
        if given:
            raise TypeError(f"{env} has its constants; not taken: {sorted(given)}")
        return env
    if "horizon" in given:
        why = "pass max_episode_steps instead: Gymnasium cuts episodes"
        raise ConfigError("env.horizon", given["horizon"], why)
    plain = {k: v.item() if isinstance(v, np.generic) else v for k, v in given.items()}
    return construct("env", env_class(env), plain)
