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
        self.members = vectors(self.space)
        self.actions = self._call("action_space", lambda: self.env.action_space)

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
        seen, info = self._values("reset", answer, "an observation, a dict")
        self.succeeded = self._success("reset", info)
        self.seen = self._vector("reset", seen)
        return self.seen

    def step(self, action: int) -> tuple[Floats, float, bool, bool]:
        """Observation (d,), reward, terminated, truncated; actions count from 0."""
        if self.env is None:
            self._replay()
        self.taken.append(action)
        first = getattr(self.actions, "start", 0)
        answer = self._call("step", self.env.step, first + action)
        names = "observation, reward, terminated, truncated, info"
        seen, reward, ended, cut, info = self._values("step", answer, names)
        self.seen = self._vector("step", seen)
        number = self._plain("reward", reward, float)
        ended = self._plain("terminated", ended, bool)
        cut = self._plain("truncated", cut, bool)
        self.succeeded = self._success("step", info)
        return self.seen, number, ended, cut

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
            problem = f"raised {described(error)}"
            expected = "no error, and the methods of Gymnasium 0.26 and later"
            raise self.broken(method, problem, expected) from error

    def _values(self, method: str, answer: Any, names: str) -> Any:
        """The values of an answer, as many as `names` says."""
        sequence, count = isinstance(answer, (tuple, list)), names.count(",") + 1
        if sequence and len(answer) == count:
            return answer
        found = f"{len(answer)} values" if sequence else _shown(answer)
        expected = f"{count} values: {names}, as in Gymnasium 0.26 and later"
        raise self.broken(method, f"gave {found}", expected)

    def _vector(self, method: str, seen: Any) -> Floats:
        """An observation as a new vector (d,) of finite numbers."""
        space = self.members
        if self._map is not None:
            method, space = f"env.observation={self.recipe.observation}", None
            seen = self._call(method, self._map, seen)
        if space is None or isinstance(space, spaces.Box):
            seen = array = self._call(method, np.asarray, seen)
            fits = array.dtype.kind in "biuf"
            fits &= space is None or array.size == math.prod(space.shape)
        elif fits := self._call(method, space.contains, seen):
            array = self._call(method, spaces.flatten, space, seen)
        if not fits:
            expected = f"real numbers, a member of {str(space)[:90]}"
            raise self.broken(method, f"gave {_shown(seen)}", expected)
        vector = np.array(array, np.float64).reshape(-1)
        d = self.state_dim = self.state_dim or len(vector)
        if len(vector) != max(d, 1):
            expected = f"{max(d, 1)} or, at the first reset, more"
            raise self.broken(method, f"gave {len(vector)} numbers", expected)
        if not np.abs(vector).max() <= LARGEST:
            worst = vector[np.argmin(np.abs(vector) <= LARGEST)]
            expected = f"finite numbers of at most {LARGEST:.3g} (float32)"
            raise self.broken(method, f"gave {worst} in an observation", expected)
        return vector

    def _plain(self, name: str, value: Any, kind: type[float]) -> Any:
        """One finite number (kind float) or one boolean, from an array or a scalar."""
        if type(value) is kind and math.isfinite(value):
            return value
        array = self._call(f"step's {name}", np.asarray, value)
        number = (
            array.item() if array.size == 1 and array.dtype.kind in "biuf" else None
        )
        if number is None or not math.isfinite(number) or kind(number) != number:
            expected = "True or False" if kind is bool else "one finite real number"
            raise self.broken("step", f"gave {name} {_shown(value)}", expected)
        return kind(number)

    def _success(self, method: str, info: Any) -> bool:
        """Whether info reports a success; a rate, a text or None reports nothing."""
        if not isinstance(info, dict):
            problem = f"gave info {_shown(info)}"
            raise self.broken(method, problem, "a dict as last value")
        for key in _SUCCESS_KEYS:
            value = self._call(f"{method}'s info of {key}", np.asarray, info.get(key))
            if value.dtype.kind in "biuf" and np.isin(value, (0, 1)).all():
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
        self, state: Any, action: NDArray, noise: Any, lanes: Any = ...
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


def vectors(space: Any) -> spaces.Space | None:
    """A space whose members become vectors of one length, its Boxes without bounds.

    So no cast hides what float32 does not resolve. None for other spaces.
    """
    if isinstance(space, spaces.Box):
        return spaces.Box(-np.inf, np.inf, space.shape, np.float64)
    if isinstance(space, spaces.Dict):
        named: Any = [(key, vectors(part)) for key, part in space.items()]
        return None if any(part is None for _, part in named) else spaces.Dict(named)
    if isinstance(space, spaces.Tuple):
        parts: Any = list(map(vectors, space))
        return None if None in parts else spaces.Tuple(parts)
    return space if isinstance(space, _VECTORS) else None


def _shown(value: Any) -> str:
    """A wrong value in a message, on one short line, with its type."""
    if isinstance(value, np.ndarray) and value.ndim:
        return f"an array of shape {value.shape} and type {value.dtype}"
    text = " ".join(reprlib.repr(value).split())
    return f"{text} of type {type(value).__name__}"


def _close(env: gymnasium.Env) -> None:
    with suppress(Exception):  # no result depends on it
        env.close()
