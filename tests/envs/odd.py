"""Environments as people plug them in, each one odd in one way."""

import collections
import os
import sys
import tempfile

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Text


def box(*shape, low=-np.inf, high=np.inf, dtype=np.float64):
    return Box(low, high, shape, dtype)


class Walk(gymnasium.Env):
    """A well-behaved walk on a ring of 7 cells; cell 0 ends it and pays 1."""

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
        return cell(self.at)

    def step(self, action):
        self.steps += 1
        self.at = (self.at + 2 * int(action) - 1) % 7
        return self.give(self.see(), 1.0 if self.at == 0 else -self.cost, self.at == 0)

    def give(self, seen, reward, ended):
        return seen, reward, ended, False, {}


def see(function, space=Walk.observation_space):
    """A walk that shows `function` of its cell."""
    return {"see": lambda self: function(self.at), "observation_space": space}


def give(function):
    """A walk whose step returns `function` of observation, reward and end."""
    return {"give": lambda self, *found: function(*found)}


def rewards(function):
    return give(lambda s, r, end: (s, function(r), end, False, {}))


def ends(function, cut=False):
    return give(lambda s, r, end: (s, r, function(end), cut, {}))


def first(function):
    """A walk whose reset calls `function` of the seed, and then starts."""

    def start(self, seed):
        function(seed)
        return Walk.first(self, seed)

    return {"first": start}


def refuse():
    raise OSError("no")


def cell(at):
    return np.array([float(at)])


class ActionsFrom5(Walk):
    action_space = Discrete(2, start=5)

    def step(self, action):
        return super().step(action - 5)


class ModeWithoutDefault(Walk):
    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, render_mode, cost=0.5):
        if render_mode != "rgb_array":
            raise ValueError(f"no mode {render_mode}")
        super().__init__(render_mode, cost)


class NoEarlyReset(Walk):
    over = True

    def reset(self, *, seed=None, options=None):
        if not self.over:
            raise RuntimeError("the episode isn't over")
        self.over = False
        return super().reset(seed=seed)

    def give(self, *found):
        self.over = found[-1]
        return super().give(*found)


class WornByResets(Walk):
    resets = 0

    def first(self, seed):
        self.resets += 1
        return super().first(seed) if self.resets == 1 else 5


class HoldsAFile(Walk):
    def __init__(self):
        super().__init__()
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
    "RewardInAnArray": rewards(lambda r: np.array([r])),
    "RewardInNumPy": rewards(np.float32),
    "EndsInArrays": ends(lambda end: np.array([end]), np.array(False)),
    "EndsInNumbers": ends(int, np.int8(0)),
    "BothAtOnce": give(lambda s, r, end: (s, r, end, end, {})),
    "OrderedInfo": give(lambda *found: (*found, False, collections.OrderedDict(a=1))),
    "ListsForArrays": see(lambda at: [at]),
    "Row": see(lambda at: np.array([[float(at)]])),
    "Bare": see(float, box()),
    "InATuple": see(lambda at: (cell(at),), gymnasium.spaces.Tuple((box(1),))),
    "InADict": see(lambda at: {"a": {"b": cell(at)}}, Dict(a=Dict(b=box(1)))),
    "SignedSeed": first(lambda n: np.array(n).astype(np.int32, casting="same_value")),
    "CloseFails": {"close": lambda self: refuse()},
}
OWN = [ActionsFrom5, ModeWithoutDefault, NoEarlyReset]
OWN += [WornByResets, HoldsAFile, OneBuffer]


def bits(at):
    return np.array([at >> k & 1 for k in range(3)], np.int8)


def both(at):
    return np.r_[np.eye(7)[at], np.eye(2)[at % 2]]


def picture(at):
    return np.full((4, 5, 3), 30 * at, np.uint8)


def late(at):
    return np.array([1.7e9 + at])


INT, FLOAT32 = box(1, low=-9, high=9, dtype=np.int64), box(1, dtype=np.float32)
PICTURE = box(4, 5, 3, low=0, high=255, dtype=np.uint8)
#: Vectors that stand for the cell: the expected vector, what is shown, and its space.
VECTORS = {
    "Numbered": (lambda at: np.eye(7)[at], int, Discrete(7)),
    "Several": (both, lambda at: np.array([at, at % 2]), MultiDiscrete([7, 2])),
    "Bits": (bits, bits, MultiBinary(3)),
    "Picture": (lambda at: np.full(60, 30.0 * at), picture, PICTURE),
    "InACoarserDict": (cell, lambda at: {"at": cell(at)}, Dict(at=INT)),
    "TooLateForFloat32": (late, lambda at: {"at": late(at)}, Dict(at=FLOAT32)),
}
COUNTS = collections.Counter()  # what all simulators share


def shared(at):
    COUNTS["steps"] += 1
    return cell(at + COUNTS["steps"] % 5)


def late_dice(self, action):
    self.steps += 1
    noise = int.from_bytes(os.urandom(4), "big") if self.steps > 70 else 0
    return cell(self.steps + noise), -1.0, False, False, {}


def words(at):
    return {"at": cell(at), "goal": "go"}


OUTLIVES = first(lambda seed: COUNTS.update(episodes=1))
OUTLIVES |= see(lambda at: cell(at + COUNTS["episodes"]))
#: Rejected before any work: words of the message, which names the method, the answer
#: and what is expected; and what is odd.
REJECTED = {
    "OldReset": ("reset … array … 0.26", {"reset": lambda self, **_: np.zeros(1)}),
    "OldStep": ("step … 4 values … truncated", give(lambda *found: (*found, {}))),
    "NoSeed": ("reset … seed … 0.26", {"reset": lambda self: Walk.reset(self)}),
    "StepGivesNothing": ("step … None … 5 values", give(lambda *_: None)),
    "OtherShape": ("reset … (1,) … (3,)", {"observation_space": box(3)}),
    "TextSeen": ("reset … <U1 … numbers", see(lambda at: np.array([str(at)]))),
    "NothingSeen": ("reset … None … numbers", see(lambda at: None)),
    "OutOfNumbers": ("Discrete(4) … type int … member", see(int, Discrete(4))),
    "KeyMissing": ("reset … 'a' … 'b'", see(lambda at: {"a": 1}, Dict(b=box(1)))),
    "NotANumber": ("step … nan … finite", see(lambda at: np.array([at or np.nan]))),
    "Huge": ("reset … e+300 … float32", see(lambda at: np.array([1e300 * at]))),
    "RewardAsText": ("step … reward '-0.5' … number", rewards(str)),
    "TwoRewards": ("step … (2,) … number", rewards(lambda r: np.array([r, r]))),
    "EndlessReward": ("step … reward inf … finite", rewards(lambda r: np.inf)),
    "EndsInWords": ("step … terminated '' … True or False", ends(lambda end: "")),
    "InfoIsNothing": ("info None … dict", give(lambda *found: (*found, False, None))),
    "NotMade": (
        "constructor … OSError: no … odd.py:",
        {"__init__": lambda _: refuse()},
    ),
    "NoReset": ("reset … OSError: no … odd.py:", first(lambda _: refuse())),
    "Leaves": ("step … SystemExit: bye … odd.py:", give(lambda *_: sys.exit("bye"))),
    "NoSpace": ("observations None … gymnasium", {"observation_space": None}),
    "Words": ("Text … filter_keys: [at]", see(words, Dict(at=box(1), goal=Text(9)))),
    "Continuous": ("actions … Box … DiscretizeAction", {"action_space": box(1)}),
    "SeveralActions": ("MultiDiscrete", {"action_space": MultiDiscrete([2, 2])}),
    "Unseeded": ("reset … episode 1", see(lambda at: cell(at + os.urandom(1)[0]))),
    "LateDice": ("step 71 … episode 1 … reset(seed=…)", {"step": late_dice}),
    "OutlivesAll": ("reset … episode 1 … outlives a reset", OUTLIVES),
    "Shared": ("differs … expected … share", see(shared)),
}


class FailsLate(Walk):
    """Raises in the episodes of some resets, which the check before work never sees."""

    def __init__(self, doom=0):
        super().__init__()
        self.doom = doom

    def reset(self, *, seed=None, options=None):
        self.doomed = 0 < seed % 64 <= self.doom
        return super().reset(seed=seed)

    def give(self, *found):
        if self.doomed:
            raise RuntimeError("the motor is stuck")
        return super().give(*found)


ODD = SAME | {name: see(*shown) for name, (_, *shown) in VECTORS.items()}
ODD |= {name: changes for name, (_, changes) in REJECTED.items()}
OTHERS = [type(name, (Walk,), changes) for name, changes in ODD.items()]
for cls in (Walk, FailsLate, *OWN, *OTHERS):
    steps = 90 if cls.__name__ == "LateDice" else 12
    gymnasium.register(f"odd/{cls.__name__}-v0", cls, max_episode_steps=steps)
