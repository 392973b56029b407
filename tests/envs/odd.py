"""Environments as people plug them in, each one odd in one way."""

from __future__ import annotations

import collections
import fractions
import os
import sys
import tempfile
import time

import gymnasium
import numpy as np
from gymnasium.spaces import (
    Box,
    Dict,
    Discrete,
    MultiBinary,
    MultiDiscrete,
    Text,
    Tuple,
)

FREE = Box(-np.inf, np.inf, (1,), np.float64)


class Walk(gymnasium.Env):
    """A well-behaved walk on a ring of 7 cells; cell 0 ends it and pays 1."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    observation_space, action_space = FREE, Discrete(2)

    def __init__(self, render_mode=None, cost=0.5):
        self.render_mode, self.cost = render_mode, cost

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = self.first(seed)
        return self.see(), {}

    def first(self, seed):
        return int(self.np_random.integers(2, 6))

    def see(self):
        return np.array([float(self.at)])

    def step(self, action):
        self.at = (self.at + 2 * int(action) - 1) % 7
        return self.give(self.see(), 1.0 if self.at == 0 else -self.cost, self.at == 0)

    def give(self, seen, reward, ended):
        return seen, reward, ended, False, {}


# --- the same numbers as Walk ---------------------------------------------------------


class RewardInAnArray(Walk):
    def give(self, seen, reward, ended):
        return seen, np.array([reward], np.float32), ended, False, {}


class NumpyScalars(Walk):
    def give(self, seen, reward, ended):
        return seen, np.float32(reward), np.bool_(ended), np.bool_(False), {}


class EverythingInArrays(Walk):
    def give(self, seen, reward, ended):
        return seen, np.array([[reward]]), np.array([ended]), np.array(False), {}


class EndsInNumbers(Walk):
    def give(self, seen, reward, ended):
        return seen, fractions.Fraction(reward), int(ended), np.int8(0), {}


class OneBuffer(Walk):
    buffer = np.zeros(1)

    def see(self):
        self.buffer[0] = self.at
        return self.buffer


class ListsForArrays(Walk):
    def see(self):
        return [self.at]


class Row(Walk):
    def see(self):
        return np.array([[float(self.at)]])


class Bare(Walk):
    observation_space = Box(-np.inf, np.inf, (), np.float64)

    def see(self):
        return float(self.at)


class InATuple(Walk):
    observation_space = Tuple((FREE,))

    def see(self):
        return (np.array([float(self.at)]),)


class InADict(Walk):
    observation_space = Dict({"at": Dict({"cell": FREE})})

    def see(self):
        return {"at": {"cell": np.array([float(self.at)])}}


class InACoarserDict(Walk):
    observation_space = Dict({"at": Box(-9.0, 9.0, (1,), np.int64)})

    def see(self):
        return {"at": np.array([float(self.at)])}


class ActionsFrom5(Walk):
    action_space = Discrete(2, start=5)

    def step(self, action):
        return super().step(action - 5)


class ModeWithoutDefault(Walk):
    def __init__(self, render_mode, cost=0.5):
        if render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"no mode {render_mode}")
        super().__init__(render_mode, cost)


class LegacySeed(Walk):
    def first(self, seed):
        np.random.RandomState(seed)
        return super().first(seed)


class SignedSeed(Walk):
    def first(self, seed):
        np.array([seed], np.int64).astype(np.int32, casting="same_value")
        return super().first(seed)


class NoEarlyReset(Walk):
    over = True

    def reset(self, *, seed=None, options=None):
        if not self.over:
            raise RuntimeError("the episode isn't over")
        self.over = False
        return super().reset(seed=seed)

    def give(self, seen, reward, ended):
        self.over = ended
        return seen, reward, ended, False, {}


class WornByResets(Walk):
    resets = 0

    def first(self, seed):
        self.resets += 1
        return super().first(seed) if self.resets == 1 else 5


class OrderedInfo(Walk):
    def give(self, seen, reward, ended):
        return seen, reward, ended, False, collections.OrderedDict(at=self.at)


class CloseFails(Walk):
    def close(self):
        raise RuntimeError("nothing to close")


class HoldsAFile(Walk):
    def __init__(self, render_mode=None, cost=0.5):
        super().__init__(render_mode, cost)
        self.file = tempfile.NamedTemporaryFile(prefix="held")  # noqa: SIM115

    def close(self):
        self.file.close()


class SeedsTheGlobal(Walk):
    def first(self, seed):
        np.random.seed(seed % 1000)  # noqa: NPY002
        return super().first(seed)


class BothAtOnce(Walk):
    def give(self, seen, reward, ended):
        return seen, reward, ended, ended, {}


# --- numbers of their own, all of them right ------------------------------------------


class Numbered(Walk):
    observation_space = Discrete(7)

    def see(self):
        return self.at


class Several(Walk):
    observation_space = MultiDiscrete([7, 2])

    def see(self):
        return np.array([self.at, self.at % 2])


class Bits(Walk):
    observation_space = MultiBinary(3)

    def see(self):
        return np.array([(self.at >> k) & 1 for k in range(3)], np.int8)


class Picture(Walk):
    observation_space = Box(0, 255, (4, 5, 3), np.uint8)

    def see(self):
        return np.full((4, 5, 3), 30 * self.at, np.uint8)


# --- refused before any work ----------------------------------------------------------


class OldReset(Walk):
    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)[0]


class OldStep(Walk):
    def give(self, seen, reward, ended):
        return seen, reward, ended, {}


class NoSeed(Walk):
    def reset(self):
        return super().reset()


class StepGivesNothing(Walk):
    def give(self, seen, reward, ended):
        return None


class OtherShape(Walk):
    observation_space = Box(-np.inf, np.inf, (3,), np.float64)


class Growing(Walk):
    observation_space = Box(-np.inf, np.inf, (2,), np.float64)

    def see(self):
        return np.zeros(2 + (self.at == 0))


class TextSeen(Walk):
    def see(self):
        return np.array([str(self.at)])


class NothingSeen(Walk):
    def see(self):
        return None


class OutOfNumbers(Walk):
    observation_space = Discrete(4)

    def see(self):
        return self.at


class KeyMissing(Walk):
    observation_space = Dict({"a": FREE, "b": FREE})

    def see(self):
        return {"a": np.zeros(1)}


class NoTuple(Walk):
    observation_space = Tuple((FREE,))

    def see(self):
        return np.array(5.0)


class NothingInside(Walk):
    observation_space = Dict({})

    def see(self):
        return {}


class NotANumber(Walk):
    def see(self):
        return np.array([np.nan if self.at == 0 else self.at])


class RewardOfNothing(Walk):
    def give(self, seen, reward, ended):
        return seen, None, ended, False, {}


class RewardAsText(Walk):
    def give(self, seen, reward, ended):
        return seen, str(reward), ended, False, {}


class TwoRewards(Walk):
    def give(self, seen, reward, ended):
        return seen, np.array([reward, reward]), ended, False, {}


class EndlessReward(Walk):
    def give(self, seen, reward, ended):
        return seen, np.inf, ended, False, {}


class EndsInWords(Walk):
    def give(self, seen, reward, ended):
        return seen, reward, "done" if ended else "", False, {}


class CutIsNothing(Walk):
    def give(self, seen, reward, ended):
        return seen, reward, ended, None, {}


class InfoIsNothing(Walk):
    def give(self, seen, reward, ended):
        return seen, reward, ended, False, None


class NotMade(Walk):
    def __init__(self, render_mode=None, cost=0.5):
        raise OSError("no simulator on this machine")


class NoReset(Walk):
    def first(self, seed):
        raise KeyError("no map")


class NoStep(Walk):
    def see(self):
        if self.at == 0:
            raise IndexError("off the map")
        return super().see()


class Leaves(Walk):
    def give(self, seen, reward, ended):
        sys.exit("bye")


class Huge(Walk):
    def see(self):
        return np.array([1e300 * self.at])


class NoSpace(Walk):
    observation_space = None


class Words(Walk):
    observation_space = Dict({"at": FREE, "goal": Text(9)})

    def see(self):
        return {"at": np.array([float(self.at)]), "goal": "go"}


class Continuous(Walk):
    action_space = Box(-1.0, 1.0, (1,))


class SeveralActions(Walk):
    action_space = MultiDiscrete([2, 2])


class Unseeded(Walk):
    def see(self):
        return np.array([self.at + np.random.default_rng().random()])


class LateDice(Walk):
    """Random without a seed, but only after many steps."""

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return super().reset(seed=seed)

    def step(self, action):
        self.steps += 1
        late = self.steps > 70
        noise = float.fromhex(os.urandom(4).hex()) if late else 0.0
        return np.array([self.steps + noise]), -1.0, False, False, {}


class OutlivesAll(Walk):
    episodes = [0]  # noqa: RUF012

    def first(self, seed):
        self.episodes[0] += 1
        return super().first(seed)

    def see(self):
        return np.array([float(self.at + self.episodes[0])])


class Shared(Walk):
    """All simulators walk on one ring."""

    ring = {}  # noqa: RUF012

    def see(self):
        self.ring["steps"] = self.ring.get("steps", 0) + 1
        return np.array([float(self.at), float(self.ring["steps"] % 5)])[:1] + (
            self.ring["steps"] % 5
        )


class Clock(Walk):
    def see(self):
        return np.array([self.at + time.perf_counter()])


# --- well-behaved until a run is under way --------------------------------------------


class FailsLate(Walk):
    """Raises in the episodes of some resets, which the check before work never sees."""

    def reset(self, *, seed=None, options=None):
        self.doomed = 0 < seed % 64 <= self.doom
        return super().reset(seed=seed)

    def __init__(self, render_mode=None, cost=0.5, doom=0):
        super().__init__(render_mode, cost)
        self.doom = doom

    def give(self, seen, reward, ended):
        if self.doomed:
            raise RuntimeError("the motor is stuck")
        return seen, reward, ended, False, {}


for name, cls in list(globals().items()):
    if isinstance(cls, type) and issubclass(cls, Walk):
        steps = 90 if cls is LateDice else 12
        gymnasium.register(f"odd/{name}-v0", cls, max_episode_steps=steps)
