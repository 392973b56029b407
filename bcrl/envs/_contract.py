"""One foreign environment, held to Gymnasium's contract; its values are made plain."""

from __future__ import annotations

import traceback
import weakref
from collections.abc import Callable
from contextlib import suppress
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bcrl.common.signals import Interrupted
from bcrl.envs._success import KEYS
from bcrl.errors import BcrlError

if TYPE_CHECKING:
    from bcrl.envs.gymnasium import Gymnasium

#: Learners see float32.
LARGEST = float(np.finfo(np.float32).max)
#: What ends more than one simulator.
PASSING = (BcrlError, Interrupted, KeyboardInterrupt, GeneratorExit)
#: Spaces whose members become a vector without loss.
PLAIN = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
OURS = [Path(__file__).parents[1], Path(gymnasium.__file__).parent]
OURS += [Path(np.__file__).parent]


class Broken(BcrlError):
    """A simulator broke the contract: the method, what came, what is expected."""


class Simulator:
    """A running environment; raises Broken for whatever it does wrong.

    It is closed at the latest when nobody refers to it, or when the process exits.
    """

    def __init__(self, task: Gymnasium, render_mode: str | None = None) -> None:
        self.task = task
        self.adapted: dict[str, None] = {}  # what was made plain, in words
        self.reports = False  # whether info says if the episode is a success
        self.used = False  # whether it has been reset
        env = self.call("the constructor", task.simulator, render_mode)
        self.env = env
        self.close = weakref.finalize(self, _close, env)
        self.space = self.call("observation_space", getattr, env, "observation_space")
        self.actions = self.call("action_space", getattr, env, "action_space")

    def reset(self, seed: int) -> NDArray[np.float64]:
        """The first observation (d,) of an episode."""
        found = self.call("reset", self.env.reset, seed=seed)
        if not isinstance(found, (tuple, list)) or len(found) != 2:
            why = "2: an observation and a dict, as in Gymnasium 0.26 and later"
            raise self.broken("reset", _counted(found), why)
        seen, info = found
        self._flag("reset", info)
        first = self._observed("reset", seen)
        self.used = True
        return first

    def step(self, action: int) -> tuple[NDArray[np.float64], float, bool, bool, bool]:
        """Observation (d,), reward, terminated, truncated, and reported success."""
        found = self.call("step", self.env.step, action + self.task.first_action)
        if not isinstance(found, (tuple, list)) or len(found) != 5:
            why = "5: observation, reward, terminated, truncated and info, as in "
            why += "Gymnasium 0.26 and later (a time limit is truncated)"
            raise self.broken("step", _counted(found), why)
        seen, reward, ended, cut, info = found
        if type(reward) is not float:
            reward = self._number(reward)
        if ended is not True and ended is not False:
            ended = self._boolean("terminated", ended)
        if cut is not True and cut is not False:
            cut = self._boolean("truncated", cut)
        seen = self._observed("step", seen)
        return seen, reward, ended, cut, self._flag("step", info)

    def call(self, method: str, function: Callable, *given: Any, **named: Any) -> Any:
        """What a foreign function returns; Broken with the place where it raised."""
        try:
            return function(*given, **named)
        except PASSING:
            raise
        except BaseException as error:  # whatever foreign code raises, SystemExit too
            text = f"raised {type(error).__name__}: {_line(error)} ({place_of(error)})"
            hint = " reset(*, seed=None, options=None)" if method == "reset" else ""
            why = f"no error; {_pip(error)}mend the environment" + hint
            raise self.broken(method, text, why, "") from error

    def broken(
        self, method: str, came: str, expected: str, verb: str = "gave "
    ) -> Broken:
        """An error that names the environment, the method, what came, what should."""
        text = f"{method} {verb}{came}; expected {expected}"
        return Broken(f"env.id={self.task.id}: {text}")

    def unfit(self, method: str, seen: NDArray[np.float64], reward: float) -> Broken:
        """The error for numbers that no learner can use."""
        if np.isfinite(reward):
            place = int(np.flatnonzero(~(np.abs(seen) <= LARGEST))[0])
            came = f"an observation with {seen[place]} as component {place}"
        else:
            came = f"reward {reward}"
        why = f"numbers that are finite, observations at most {LARGEST:.3g} (float32)"
        return self.broken(method, came, f"{why}; env.wrappers may rescale")

    def _observed(self, method: str, seen: Any) -> NDArray[np.float64]:
        """An observation as a new vector (d,)."""
        if self.task.observation is not None:
            method = f"env.observation={self.task.observation}"
            seen = self.call(method, self.task.map, seen)
            vector = self._array(method, seen).reshape(-1)
        elif isinstance(self.space, spaces.Box):
            array = self._array(method, seen)
            vector = array.reshape(-1)
            if array.shape != self.space.shape:
                if vector.size != np.prod(self.space.shape):
                    why = f"shape {self.space.shape}, as observation_space says"
                    raise self.broken(method, _came(seen), why)
                text = f"observations of shape {array.shape} are taken as of shape "
                self.adapted[f"{text}{self.space.shape}"] = None
        else:
            parts = self._parts(method, self.space, seen)
            vector = np.concatenate([np.empty(0), *parts])
            if not self.used:
                text = f"observations, {_short(self.space)}, are flattened to "
                text += f"{len(vector)} numbers, as FlattenObservation does"
                self.adapted[text] = None
        if not vector.size:
            raise self.broken(method, "nothing", "at least one number")
        expected = self.task.__dict__.get("state_dim", len(vector))
        if len(vector) != expected:
            why = f"{expected}, as many as after the first reset"
            raise self.broken(method, f"{len(vector)} numbers", why)
        return np.array(vector, np.float64)

    def _array(self, method: str, seen: Any) -> NDArray:
        array = self.call(method, np.asarray, seen)
        if array.dtype.kind not in "biuf":
            raise self.broken(method, _came(seen), "an array of real numbers")
        return array

    def _parts(self, method: str, space: spaces.Space, seen: Any) -> list[NDArray]:
        """The vectors of an observation's parts; Broken if one is not of its space."""
        if isinstance(space, spaces.Box):
            array = self._array(method, seen)
            if array.shape != space.shape:
                raise self.broken(method, _came(seen), f"shape {space.shape}")
            return [array.reshape(-1)]  # not of the Box's type, which may be coarser
        if not isinstance(space, (spaces.Dict, spaces.Tuple)):
            if not self.call(method, space.contains, seen):
                raise self.broken(method, _came(seen), f"a member of {_short(space)}")
            return [self.call(method, spaces.flatten, space, seen)]
        named = isinstance(space, spaces.Dict)
        if isinstance(seen, np.ndarray) and seen.ndim:
            seen = tuple(seen)
        if isinstance(seen, dict if named else (tuple, list)):
            keys = seen.keys() if named else range(len(seen))
            inner = space.spaces if named else dict(enumerate(space.spaces))
            if set(keys) == set(inner):
                found = (
                    self._parts(f"{method} [{key!r}]", part, seen[key])
                    for key, part in inner.items()
                )
                return [vector for vectors in found for vector in vectors]
        raise self.broken(method, _came(seen), f"a member of {_short(space)}")

    def _number(self, reward: Any) -> float:
        if isinstance(reward, Real):
            return self.call("step's reward", float, reward)
        array = self.call("step's reward", np.asarray, reward)
        if array.dtype.kind not in "biuf" or array.size != 1:
            raise self.broken("step", f"reward {_came(reward)}", "one real number")
        if array.ndim:
            text = f"rewards, arrays of shape {array.shape}, are taken as numbers"
            self.adapted[text] = None
        return float(array.reshape(-1)[0])

    def _boolean(self, name: str, value: Any) -> bool:
        array = self.call(f"step's {name}", np.asarray, value)
        if array.size != 1 or not _true_or_false(array):
            raise self.broken("step", f"{name} {_came(value)}", "True or False")
        if array.ndim or array.dtype.kind != "b":
            text = f"{name}, {_kind(array)}, are taken as booleans"
            self.adapted[text] = None
        return bool(array.reshape(-1)[0])

    def _flag(self, method: str, info: Any) -> bool:
        """Whether info says that the episode is a success."""
        if not isinstance(info, dict):
            raise self.broken(method, f"info {_came(info)}", "a dict as the last value")
        for key in KEYS:
            if key in info:
                value = self.call(f'{method}\'s info["{key}"]', np.asarray, info[key])
                if _true_or_false(value):  # a rate, a text or None says nothing
                    self.reports = True
                    return bool(value.all())
        return False


def plain_parts(space: spaces.Space) -> bool:
    """Whether the members of a space can be flattened to a vector of fixed length."""
    if isinstance(space, spaces.Dict):
        return all(map(plain_parts, space.spaces.values()))
    if isinstance(space, spaces.Tuple):
        return all(map(plain_parts, space.spaces))
    return isinstance(space, PLAIN)


def _true_or_false(array: NDArray) -> bool:
    """Whether all entries are booleans, or the numbers 0 and 1."""
    return array.dtype.kind in "biuf" and bool(((array == 0) | (array == 1)).all())


def _kind(array: NDArray) -> str:
    return f"arrays of shape {array.shape}" if array.ndim else f"{array.dtype} numbers"


def _close(env: gymnasium.Env) -> None:
    with suppress(Exception):  # what it holds is its own; nothing depends on it
        env.close()


def _counted(found: Any) -> str:
    many = isinstance(found, (tuple, list))
    return f"{len(found)} values, {_short(found)}" if many else _came(found)


def _came(value: Any) -> str:
    if isinstance(value, np.ndarray) and value.ndim:
        return f"an array of shape {value.shape} and type {value.dtype}"
    return f"{_short(value)}, of type {type(value).__name__},"


def _short(value: Any) -> str:
    try:
        text = " ".join(repr(value).split())
    except Exception:  # of foreign code, too
        text = f"a {type(value).__name__}"
    return text if len(text) <= 70 else f"{text[:69]}…"


def _line(error: BaseException) -> str:
    lines = str(error).strip().splitlines() or [""]
    return lines[0][:200]


def place_of(error: BaseException) -> str:
    """Where in foreign code an error arose, as `…/file.py:12`."""
    frames = traceback.extract_tb(error.__traceback__)
    files = [f for f in frames if not f.filename.startswith("<")]
    foreign = [f for f in files if not {*OURS} & {*Path(f.filename).parents}]
    frame = (foreign or files)[-1]
    return f"…/{Path(frame.filename).name}:{frame.lineno}"


def _pip(error: BaseException) -> str:
    if isinstance(error, ModuleNotFoundError) and error.name:
        return f"pip install {error.name.partition('.')[0]}, or "
    return ""
