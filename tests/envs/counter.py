"""For tests: environments that count their steps, registered with Gymnasium."""

import itertools

import gymnasium
import numpy as np

COUNTER, ENDLESS, SCORED = (f"tests/{n}-v0" for n in ("Counter", "Endless", "Scored"))
MOODS = itertools.count()


class Counter(gymnasium.Env):
    """Counts its steps; `prize` at 5; truncates itself at 3 with `stop`."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gymnasium.spaces.Discrete(2, start=7)

    def __init__(self, stop=False, prize=1.0, moody=False, sums=None):
        self.stop, self.prize, self.own = stop, prize, 2.0
        self.moody, self.sums = moody, sums or [0.0]

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.own = 0, 2.0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.steps += 1
        self.sums[0] += 1.0
        end, cut = self.steps == 5, self.stop and self.steps == 3
        seen = np.full(1, self.steps + (next(MOODS) if self.moody else 0), np.float32)
        return seen, self.prize * end, end, cut, {}


class Scored(Counter):
    """Reports success in info after every step with action 8."""

    def step(self, action):
        *found, _ = super().step(action)
        return *found, {"is_success": np.array([action == 8])}


gymnasium.register(COUNTER, Counter, max_episode_steps=9)
gymnasium.register(ENDLESS, Counter)
gymnasium.register(SCORED, Scored, max_episode_steps=9)
