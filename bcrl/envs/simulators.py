"""Simulators whose every answer is checked, one by one or side by side."""

import math
import reprlib
import weakref
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bcrl.common.serialization import DERIVED, storable
from bcrl.common.signals import Interrupted
from bcrl.envs.base import Bools, Floats, Lanes
from bcrl.envs.checks import LARGEST, described
from bcrl.errors import BcrlError

_SEEDS = 2**31  # resets take seeds below: every 32-bit generator accepts them
_SUCCESS_KEYS = ("is_success", "success")  # of info
#: Spaces whose members become a vector without loss.
_VECTORS = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
#: Errors that end more than one simulator.
_PASSING = (BcrlError, Interrupted, KeyboardInterrupt, GeneratorExit)
_SHORT = reprlib.Repr()
_SHORT.maxother = 90


class BrokenSimulator(BcrlError):
    """A wrong answer of a simulator: names the method, the answer, what is expected."""


@storable
@dataclass(eq=False)
class Simulator:
    """One environment, made when it is needed; a wrong answer raises BrokenSimulator.

    `state_dim`: numbers in an observation; 0 takes those of the first one. `fresh`:
    every episode needs a new environment. An episode follows from the number that reset
    it and the actions since. Only these are stored: a simulator that was closed, or is
    from a checkpoint, plays them again.
    """

    recipe: Any  # a Recipe
    state_dim: int = 0
    fresh: bool = False
    render_mode: str | None = None
    reports: bool = False  # whether info has a success key
    number: float = 0.0  # of the latest reset
    taken: list[int] = field(default_factory=list)  # actions since
    seen: Floats = field(default_factory=lambda: np.empty(0))  # latest observation
    succeeded: bool = field(default=False, metadata=DERIVED)  # by the latest info
    env: Any = field(default=None, metadata=DERIVED)  # None if closed

    def open(self) -> None:
        """Make a new environment; it is closed at the latest when the process exits."""
        self.close()
        self._map = self.recipe.mapping()
        self.env = self._call("the constructor", self.recipe.make, self.render_mode)
        self._finalizer = weakref.finalize(self, _close, self.env)
        self.seen = np.empty(0)
        self.space = self._call("observation_space", lambda: self.env.observation_space)
        self.actions = self._call("action_space", lambda: self.env.action_space)
        self._first_action: Any = getattr(self.actions, "start", 0)

    def close(self) -> None:
        """Close the environment."""
        if self.env is not None:
            self._finalizer()
            self.env = None

    def reset(self, number: float) -> Floats:
        """The first observation (d,) of the episode that a number in [0, 1) seeds."""
        self.number, self.taken, used = number, [], self.seen.size > 0
        if used and self.env is not None and not self.fresh:
            # It may allow no reset before the end of an episode.
            with suppress(BrokenSimulator):
                return self._reset()
        if used or self.env is None:
            self.open()
        return self._reset()

    def _reset(self) -> Floats:
        answer = self._call("reset", self.env.reset, seed=int(self.number * _SEEDS))
        seen, info = self._values("reset", answer, 2, "an observation and a dict")
        self.succeeded = self._success("reset", info)
        self.seen = self._vector("reset", seen)
        return self.seen

    def step(self, action: int) -> tuple[Floats, float, bool, bool]:
        """Observation (d,), reward, terminated, truncated; actions count from 0."""
        if self.env is None:
            self._replay()
        self.taken.append(action)
        answer = self._call("step", self.env.step, action + self._first_action)
        names = "observation, reward, terminated, truncated and info"
        seen, reward, ended, cut, info = self._values("step", answer, 5, names)
        self.seen = self._vector("step", seen)
        plain = (
            self._plain("reward", reward, float),
            self._plain("terminated", ended, bool),
            self._plain("truncated", cut, bool),
        )
        self.succeeded = self._success("step", info)
        return self.seen, *plain

    def _replay(self) -> None:
        number, taken, seen = self.number, self.taken, self.seen
        self.reset(number)
        for action in taken:
            self.step(action)
        if not np.array_equal(self.seen, seen):
            problem = f"gave another observation after {len(taken)} steps of a replay"
            expected = "the same after the same reset(seed=…) and actions"
            raise self.broken("step", problem, expected)

    def broken(self, method: str, problem: str, expected: str) -> BrokenSimulator:
        """The error that names the environment, method, problem and expected answer."""
        text = f"env.id={self.recipe.id}: {method} {problem}; expected {expected}"
        return BrokenSimulator(text)

    def _call(self, method: str, function: Callable, *given: Any, **named: Any) -> Any:
        """The answer of a foreign function; its error becomes BrokenSimulator."""
        try:
            return function(*given, **named)
        except _PASSING:
            raise
        except BaseException as error:  # any foreign error, SystemExit too
            missing = isinstance(error, ModuleNotFoundError) and error.name
            install = f"pip install {missing.partition('.')[0]}, or " if missing else ""
            expected = f"no error; {install}mend the environment"
            if method == "reset":
                expected += " (reset(*, seed=None, options=None))"
            raise self.broken(method, f"raised {described(error)}", expected) from error

    def _values(self, method: str, answer: Any, count: int, names: str) -> Any:
        is_sequence = isinstance(answer, (tuple, list))
        if is_sequence and len(answer) == count:
            return answer
        found = f"{len(answer)} values" if is_sequence else _shown(answer)
        expected = f"{count} values, {names}, as in Gymnasium 0.26 and later"
        raise self.broken(method, f"gave {found}", expected)

    def _vector(self, method: str, seen: Any) -> Floats:
        """An observation as a new vector (d,) of finite numbers."""
        space = self.space
        if self._map is not None:
            method, space = f"env.observation={self.recipe.observation}", None
            seen = self._call(method, self._map, seen)
        vector = np.array(self._flat(method, space, seen), np.float64)
        d = self.state_dim = self.state_dim or len(vector)
        if len(vector) != max(d, 1):
            expected = f"{max(d, 1)} or, at the first reset, more"
            raise self.broken(method, f"gave {len(vector)} numbers", expected)
        if not np.abs(vector).max() <= LARGEST:
            place = np.flatnonzero(~(np.abs(vector) <= LARGEST))[0]
            problem = f"gave an observation with {vector[place]} as component {place}"
            expected = f"finite numbers of at most {LARGEST:.3g} (float32); "
            expected += "a wrapper in env.wrappers may rescale them"
            raise self.broken(method, problem, expected)
        return vector

    def _flat(self, method: str, space: spaces.Space | None, seen: Any) -> NDArray:
        """A member of `space` (None: any numbers) as a vector, without a cast."""
        if (parts := _parts(space)) is not None:
            sequence = isinstance(seen, (tuple, list))
            keys = range(len(seen)) if sequence else seen
            if (sequence or isinstance(seen, dict)) and set(keys) == parts.keys():
                found = (
                    self._flat(f"{method} [{key!r}]", part, seen[key])
                    for key, part in parts.items()
                )
                return np.concatenate([np.empty(0), *found])
        elif space is None or isinstance(space, spaces.Box):
            array = self._call(method, np.asarray, seen)
            fits = space is None or array.size == math.prod(space.shape)
            if fits and array.dtype.kind in "biuf":
                return array.reshape(-1)
        elif self._call(method, space.contains, seen):
            return self._call(method, spaces.flatten, space, seen)
        member = f", a member of {shortened(space)}" if space else ""
        raise self.broken(method, f"gave {_shown(seen)}", f"real numbers{member}")

    def _plain(self, name: str, value: Any, kind: type[float]) -> Any:
        """One finite number (kind float) or one boolean, from an array or a scalar."""
        if type(value) is kind and math.isfinite(value):
            return value
        array = self._call(f"step's {name}", np.asarray, value)
        number = array.dtype.kind in "biuf" and np.isfinite(array).all()
        if array.size != 1 or not (_is_boolean(array) if kind is bool else number):
            expected = "True or False" if kind is bool else "one finite real number"
            raise self.broken("step", f"gave {name} {_shown(value)}", expected)
        return kind(array.item())

    def _success(self, method: str, info: Any) -> bool:
        """Whether info reports a success; a rate, a text or None reports nothing."""
        if not isinstance(info, dict):
            problem = f"gave info {_shown(info)}"
            raise self.broken(method, problem, "a dict as last value")
        for key in _SUCCESS_KEYS:
            if key in info:
                value = self._call(f'{method}\'s info["{key}"]', np.asarray, info[key])
                if _is_boolean(value):
                    self.reports = True
                    return bool(value.all())
        return False


@storable
@dataclass(eq=False)
class SimulatedLanes(Lanes):
    """The lanes of a simulated task, counted in C order."""

    shape: tuple[int, ...] = (0,)  # the lanes' axes
    simulators: list[Simulator] = field(default_factory=list)

    def begin(self, start: Floats) -> Floats:
        """First observations (..., d) after resets by numbers (..., 1) in [0, 1)."""
        self.close()
        self.shape, self.failures = start.shape[:-1], {}
        self.simulators = [self.env.simulator() for _ in range(start[..., 0].size)]
        state = np.zeros((*self.shape, self.env.state_dim))
        return self.restart(np.ones(self.shape, bool), start, state)

    def step(
        self,
        state: Floats | None,
        action: NDArray,
        noise: Floats | None,
        lanes: Any = ...,
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Observations, rewards, terminated and truncated of the chosen lanes."""
        otherwise = np.zeros(self.env.state_dim), 0.0, False, True
        pairs = zip(self._chosen(lanes), action.reshape(-1).tolist(), strict=True)
        found = [self._answer(lane, "step", each, otherwise) for lane, each in pairs]
        after, *others = map(np.array, zip(*found, strict=True))
        reward, ended, cut = (each.reshape(action.shape) for each in others)
        return after.reshape(*action.shape, -1), reward, ended, cut

    def restart(self, over: Bools, start: Floats, state: Floats) -> Floats:
        """All observations; lanes that are over are reset."""
        state, zeros = state.copy(), np.zeros(self.env.state_dim)
        for place, lane in zip(np.argwhere(over), self._chosen(over), strict=True):
            number = float(start[tuple(place)][0])
            state[tuple(place)] = self._answer(lane, "reset", number, zeros)
        return state

    def close(self) -> None:
        """Close every simulator."""
        for simulator in self.simulators:
            simulator.close()

    @property
    def succeeded(self) -> Bools:
        """Whether the latest info of each lane reported success, (...)."""
        return np.array([s.succeeded for s in self.simulators]).reshape(self.shape)

    def _chosen(self, lanes: Any) -> list[int]:
        """The numbers of lanes that index the lanes' axes."""
        numbers = np.arange(len(self.simulators)).reshape(self.shape)
        return numbers[lanes].reshape(-1).tolist()

    def _answer(self, lane: int, method: str, argument: float, otherwise: Any) -> Any:
        """The answer of a lane's simulator; `otherwise` from the time it has failed."""
        if lane not in self.failures:
            try:
                return getattr(self.simulators[lane], method)(argument)
            except BrokenSimulator as error:
                self.failures[lane] = str(error)
                self.simulators[lane].close()
        return otherwise


def is_vector(space: spaces.Space) -> bool:
    """Whether the members of a space can be flattened to a vector of fixed length."""
    parts = _parts(space)
    if parts is None:
        return isinstance(space, _VECTORS)
    return all(map(is_vector, parts.values()))


def _parts(space: spaces.Space | None) -> dict[Any, spaces.Space] | None:
    """The spaces inside a Dict or Tuple by key or place; None for other spaces."""
    if isinstance(space, spaces.Tuple):
        return dict(enumerate(space.spaces))
    return space.spaces if isinstance(space, spaces.Dict) else None


def shortened(value: Any) -> str:
    """A value of foreign code in a message: one short line."""
    return " ".join(_SHORT.repr(value).split())


def _shown(value: Any) -> str:
    """A wrong value in a message, with its type."""
    if isinstance(value, np.ndarray) and value.ndim:
        return f"an array of shape {value.shape} and type {value.dtype}"
    return f"{shortened(value)} of type {type(value).__name__}"


def _is_boolean(array: NDArray) -> bool:
    """Whether all entries are booleans, or the numbers 0 and 1."""
    return array.dtype.kind in "biuf" and bool(((array == 0) | (array == 1)).all())


def _close(env: gymnasium.Env) -> None:
    with suppress(Exception):  # no result depends on it
        env.close()
