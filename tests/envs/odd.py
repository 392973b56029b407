"""Environments as people plug them in, each one odd in one way."""

import collections
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


def box(*shape, low=-np.inf, high=np.inf, dtype=np.float64):
    return Box(low, high, shape, dtype)


class Walk(gymnasium.Env):
    """A well-behaved walk on a ring of 7 cells; cell 0 ends it and pays 1."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    observation_space, action_space = box(1), Discrete(2)

    def __init__(self, render_mode=None, cost=0.5):
        self.render_mode, self.cost = render_mode, cost

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.steps = self.first(seed), 0
        return self.see(), {}

    def first(self, seed):
        return int(self.np_random.integers(2, 6))

    def see(self):
        return np.array([float(self.at)])

    def step(self, action):
        self.steps += 1
        self.at = (self.at + 2 * int(action) - 1) % 7
        return self.give(self.see(), 1.0 if self.at == 0 else -self.cost, self.at == 0)

    def give(self, seen, reward, ended):
        return seen, reward, ended, False, {}


def see(function, space=None):
    """A walk that shows `function` of its cell."""
    spaces = {} if space is None else {"observation_space": space}
    return {"see": lambda self: function(self.at), **spaces}


def give(function):
    """A walk whose step returns `function` of observation, reward and end."""
    return {"give": lambda self, *found: function(*found)}


def first(function):
    """A walk whose reset calls `function` of itself and the seed, and then starts."""

    def start(self, seed):
        function(self, seed)
        return Walk.first(self, seed)

    return {"first": start}


def fails(error):
    """A function that raises."""

    def function(*_, **__):
        raise error

    return function


class ActionsFrom5(Walk):
    action_space = Discrete(2, start=5)

    def step(self, action):
        return super().step(action - 5)


class ModeWithoutDefault(Walk):
    def __init__(self, render_mode, cost=0.5):
        if render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"no mode {render_mode}")
        super().__init__(render_mode, cost)


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


class HoldsAFile(Walk):
    def __init__(self, render_mode=None, cost=0.5):
        super().__init__(render_mode, cost)
        self.file = tempfile.NamedTemporaryFile(prefix="held")  # noqa: SIM115

    def close(self):
        self.file.close()


class OneBuffer(Walk):
    buffer = np.zeros(1)

    def see(self):
        self.buffer[0] = self.at
        return self.buffer


#: They learn the same numbers as Walk.
SAME = {
    "RewardInAnArray": give(lambda s, r, end: (s, np.array([r]), end, False, {})),
    "NumpyScalars": give(
        lambda s, r, end: (s, np.float32(r), np.bool_(end), np.bool_(0), {})
    ),
    "EverythingInArrays": give(
        lambda s, r, end: (s, np.array([[r]]), np.array([end]), np.array(False), {})
    ),
    "EndsInNumbers": give(lambda s, r, end: (s, r, int(end), np.int8(0), {})),
    "BothAtOnce": give(lambda s, r, end: (s, r, end, end, {})),
    "OrderedInfo": give(
        lambda s, r, end: (s, r, end, False, collections.OrderedDict(at=s))
    ),
    "ListsForArrays": see(lambda at: [at]),
    "Row": see(lambda at: np.array([[float(at)]])),
    "Bare": see(float, box()),
    "InATuple": see(lambda at: (np.array([float(at)]),), Tuple((box(1),))),
    "InADict": see(
        lambda at: {"at": {"cell": np.array([float(at)])}},
        Dict({"at": Dict({"cell": box(1)})}),
    ),
    "InACoarserDict": see(
        lambda at: {"at": np.array([float(at)])},
        Dict({"at": box(1, low=-9, high=9, dtype=np.int64)}),
    ),
    "LegacySeed": first(lambda self, seed: np.random.RandomState(seed)),
    "SignedSeed": first(
        lambda self, seed: np.array([seed]).astype(np.int32, casting="same_value")
    ),
    "SeedsTheGlobal": first(lambda self, seed: np.random.seed(seed % 1000)),  # noqa: NPY002
    "CloseFails": {"close": fails(RuntimeError("nothing to close"))},
}
CLASSES = [Walk, ActionsFrom5, ModeWithoutDefault, NoEarlyReset, WornByResets]
CLASSES += [HoldsAFile, OneBuffer]

#: Vectors that stand for the cell: what the walk shows, and the vector expected.
VECTORS = {
    "Numbered": (see(int, Discrete(7)), lambda at: np.eye(7)[at]),
    "Several": (
        see(lambda at: np.array([at, at % 2]), MultiDiscrete([7, 2])),
        lambda at: np.r_[np.eye(7)[at], np.eye(2)[at % 2]],
    ),
    "Bits": (
        see(
            lambda at: np.array([at >> k & 1 for k in range(3)], np.int8),
            MultiBinary(3),
        ),
        lambda at: np.array([at & 1, at >> 1 & 1, at >> 2 & 1], float),
    ),
    "Picture": (
        see(
            lambda at: np.full((4, 5, 3), 30 * at, np.uint8),
            box(4, 5, 3, low=0, high=255, dtype=np.uint8),
        ),
        lambda at: np.full(60, 30.0 * at),
    ),
}


COUNTS = collections.Counter()  # what all simulators share


def _shared(at):
    COUNTS["steps"] += 1
    return np.array([float(at + COUNTS["steps"] % 5)])


def _late_dice(self, action):
    """Random without a seed, but only after many steps."""
    self.steps += 1
    noise = float.fromhex(os.urandom(4).hex()) if self.steps > 70 else 0.0
    return np.array([self.steps + noise]), -1.0, False, False, {}


#: Rejected before any work: what is odd, and words of the message, which names the
#: method, the answer and what is expected.
REJECTED = {
    "OldReset": (
        {"reset": lambda self, *, seed=None, options=None: np.zeros(1)},
        ("reset", "array", "0.26"),
    ),
    "OldStep": (
        give(lambda s, r, end: (s, r, end, {})),
        ("step", "4 values", "truncated"),
    ),
    "NoSeed": (
        {"reset": lambda self: Walk.reset(self)},
        ("reset", "seed", "reset(*, seed=None, options=None)"),
    ),
    "StepGivesNothing": (give(lambda *_: None), ("step", "None", "5 values")),
    "OtherShape": ({"observation_space": box(3)}, ("reset", "(1,)", "(3,)")),
    "Growing": (
        see(lambda at: np.zeros(2 + (at == 0)), box(2)),
        ("step", "(3,)", "(2,)"),
    ),
    "TextSeen": (see(lambda at: np.array([str(at)])), ("reset", "<U1", "numbers")),
    "NothingSeen": (see(lambda at: None), ("reset", "None", "numbers")),
    "OutOfNumbers": (see(int, Discrete(4)), ("Discrete(4)", "type int", "member")),
    "KeyMissing": (
        see(lambda at: {"a": np.zeros(1)}, Dict({"a": box(1), "b": box(1)})),
        ("reset", "'a'", "'b'"),
    ),
    "NoTuple": (
        see(lambda at: np.array(5.0), Tuple((box(1),))),
        ("reset", "5.", "member of Tuple"),
    ),
    "NothingInside": (
        see(lambda at: {}, Dict({})),
        ("reset", "0 numbers", "expected 1"),
    ),
    "NotANumber": (
        see(lambda at: np.array([at or np.nan])),
        ("step", "nan", "finite"),
    ),
    "Huge": (see(lambda at: np.array([1e300 * at])), ("reset", "e+300", "float32")),
    "RewardOfNothing": (
        give(lambda s, r, end: (s, None, end, False, {})),
        ("step", "reward None", "number"),
    ),
    "RewardAsText": (
        give(lambda s, r, end: (s, str(r), end, False, {})),
        ("step", "reward '-0.5'", "number"),
    ),
    "TwoRewards": (
        give(lambda s, r, end: (s, np.array([r, r]), end, False, {})),
        ("step", "(2,)", "number"),
    ),
    "EndlessReward": (
        give(lambda s, r, end: (s, np.inf, end, False, {})),
        ("step", "reward inf", "finite"),
    ),
    "EndsInWords": (
        give(lambda s, r, end: (s, r, "done" if end else "", False, {})),
        ("step", "terminated ''", "True or False"),
    ),
    "CutIsNothing": (
        give(lambda s, r, end: (s, r, end, None, {})),
        ("step", "truncated None", "True or False"),
    ),
    "InfoIsNothing": (
        give(lambda s, r, end: (s, r, end, False, None)),
        ("step", "info None", "dict"),
    ),
    "NotMade": (
        {"__init__": fails(OSError("no simulator on this machine"))},
        ("constructor", "OSError: no simulator", "odd.py:"),
    ),
    "NoReset": (
        first(fails(KeyError("no map"))),
        ("reset", "KeyError: 'no map'", "odd.py:"),
    ),
    "NoStep": (
        see(lambda at: np.array([float(at)]) if at else fails(IndexError("off"))()),
        ("step", "IndexError: off", "odd.py:"),
    ),
    "Leaves": (
        give(lambda *_: sys.exit("bye")),
        ("step", "SystemExit: bye", "odd.py:"),
    ),
    "NoSpace": (
        {"observation_space": None},
        ("observation_space", "None", "gymnasium"),
    ),
    "Words": (
        see(
            lambda at: {"at": np.array([float(at)]), "goal": "go"},
            Dict({"at": box(1), "goal": Text(9)}),
        ),
        ("observations", "Text", "filter_keys: [at]"),
    ),
    "Continuous": (
        {"action_space": box(1, low=-1.0, high=1.0)},
        ("actions", "Box", "{name: DiscretizeAction, bins: 5}"),
    ),
    "SeveralActions": (
        {"action_space": MultiDiscrete([2, 2])},
        ("actions", "MultiDiscrete", "Discrete"),
    ),
    "Unseeded": (
        see(lambda at: np.array([at + np.random.default_rng().random()])),
        ("reset", "episode 1", "reset(seed=…)"),
    ),
    "LateDice": ({"step": _late_dice}, ("step 71", "episode 1", "reset(seed=…)")),
    "OutlivesAll": (
        {
            **first(lambda self, seed: COUNTS.update(episodes=1)),
            **see(lambda at: np.array([float(at + COUNTS["episodes"])])),
        },
        ("reset", "episode 1", "outlives a reset"),
    ),
    "Shared": (see(_shared), ("differs", "expected", "share")),
    "Clock": (
        see(lambda at: np.array([at + time.perf_counter()])),
        ("reset", "episode 1", "same reset and actions"),
    ),
}


class FailsLate(Walk):
    """Raises in the episodes of some resets, which the check before work never sees."""

    def __init__(self, render_mode=None, cost=0.5, doom=0):
        super().__init__(render_mode, cost)
        self.doom = doom

    def reset(self, *, seed=None, options=None):
        self.doomed = 0 < seed % 64 <= self.doom
        return super().reset(seed=seed)

    def give(self, seen, reward, ended):
        if self.doomed:
            raise RuntimeError("the motor is stuck")
        return seen, reward, ended, False, {}


ODD = SAME | {name: changes for name, (changes, _) in (VECTORS | REJECTED).items()}
CLASSES += [FailsLate, *(type(name, (Walk,), changes) for name, changes in ODD.items())]
for cls in CLASSES:
    steps = 90 if cls.__name__ == "LateDice" else 12
    gymnasium.register(f"odd/{cls.__name__}-v0", cls, max_episode_steps=steps)
