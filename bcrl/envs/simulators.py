"""Simulators whose every answer is checked, one by one or side by side."""

import math
import weakref
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bcrl.common import plugins
from bcrl.common.serialization import DERIVED, storable
from bcrl.common.signals import Interrupted
from bcrl.envs.base import Bools, Floats, Lanes
from bcrl.envs.checks import LARGEST, described, shown
from bcrl.errors import BcrlError

SEEDS = 2**31  # resets take seeds below: every 32-bit generator accepts them


class BrokenSimulator(BcrlError):
    """A wrong answer of a simulator, or an error of its code."""


@storable
@dataclass(eq=False)
class Simulator:
    """One environment, made when it is needed; a wrong answer raises BrokenSimulator.

    An episode follows from the number that reset it and the actions since. A simulator
    that was closed, or is from a checkpoint, plays them again.
    """

    recipe: Any  # a Recipe
    state_dim: int = 0  # numbers in an observation; 0 takes those of the first one
    fresh: bool = False  # whether every episode needs a new environment
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
        name = self.recipe.observation
        self._map = plugins.attribute("env.observation", name, name) if name else None
        self.env = self._call("the constructor", self.recipe.make, self.render_mode)
        self._finalizer = weakref.finalize(self, _close, self.env)
        self.seen = np.empty(0)
        self.space = self._call("observation_space", lambda: self.env.observation_space)
        self.members = None if self._map else vectors(self.space)
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
            with suppress(BrokenSimulator):  # no reset before an episode's end
                return self._reset()
        if used or self.env is None:
            self.open()
        return self._reset()

    def _reset(self) -> Floats:
        answer = self._call("reset", self.env.reset, seed=int(self.number * SEEDS))
        seen, info = self._values("reset", answer, "observation, info")
        self.succeeded = self._success("reset", info)
        self.seen = self.vector("reset", seen)
        return self.seen

    def step(self, action: int) -> tuple[Floats, float, bool, bool]:
        """Observation (d,), reward, terminated, truncated; actions count from 0."""
        if self.env is None:  # play the episode again
            taken, seen = self.taken, self.seen
            self.reset(self.number)
            for earlier in taken:
                self.step(earlier)
            if not np.array_equal(self.seen, seen):
                problem = f"gave another observation in a replay of {len(taken)} steps"
                raise self._wrong("step", problem, "the same after reset(seed=…)")
        self.taken.append(action)
        answer = self._call("step", self.env.step, self.actions.start + action)
        names = "observation, reward, terminated, truncated, info"
        seen, reward, ended, cut, info = self._values("step", answer, names)
        self.seen = self.vector("step", seen)
        reward = self._plain("reward", reward, float)
        ended = self._plain("terminated", ended, bool)
        cut = self._plain("truncated", cut, bool)
        self.succeeded = self._success("step", info)
        return self.seen, reward, ended, cut

    def _wrong(self, method: str, problem: str, expected: str) -> BrokenSimulator:
        found = f"env.id={self.recipe.id}: {method} {problem}"
        return BrokenSimulator(f"{found}; expected {expected}")

    def _call(self, method: str, function: Callable, *given: Any, **named: Any) -> Any:
        """The answer of a foreign function; its error becomes BrokenSimulator."""
        try:
            return function(*given, **named)
        except (BcrlError, Interrupted, KeyboardInterrupt, GeneratorExit):
            raise
        except BaseException as error:  # of foreign code, SystemExit too
            expected = "no error, and the methods of Gymnasium 0.26 and later"
            raise self._wrong(method, f"raised {described(error)}", expected) from error

    def _values(self, method: str, answer: Any, names: str) -> Any:
        sequence, count = isinstance(answer, (tuple, list)), names.count(",") + 1
        if sequence and len(answer) == count:
            return answer
        found = f"{len(answer)} values" if sequence else shown(answer)
        expected = f"{count} values: {names}, as in Gymnasium 0.26 and later"
        raise self._wrong(method, f"gave {found}", expected)

    def vector(self, method: str, seen: Any) -> Floats:
        """An observation as a new vector (d,); BrokenSimulator if it is none."""
        if self._map is not None:
            method = f"env.observation={self.recipe.observation}"
            seen = self._call(method, self._map, seen)
        space = self.members
        if space is None or isinstance(space, spaces.Box):
            seen = array = self._call(method, np.asarray, seen)
            fits = array.dtype.kind in "biuf"
            fits &= space is None or array.size == math.prod(space.shape)
        elif fits := self._call(method, space.contains, seen):
            array = self._call(method, spaces.flatten, space, seen)
        if not fits:
            expected = f"real numbers, a member of {str(space)[:90]}"
            raise self._wrong(method, f"gave {shown(seen)}", expected)
        vector = np.array(array, np.float64).reshape(-1)
        self.state_dim = self.state_dim or len(vector)
        if not len(vector) == self.state_dim > 0:
            expected = str(self.state_dim or "one or more")
            raise self._wrong(method, f"gave {len(vector)} numbers", expected)
        if not np.abs(vector).max() <= LARGEST:
            worst = vector[np.argmin(np.abs(vector) <= LARGEST)]
            expected = f"finite numbers of at most {LARGEST:.3g} (float32)"
            raise self._wrong(method, f"gave {worst} in an observation", expected)
        return vector

    def _plain(self, name: str, value: Any, kind: type[float]) -> Any:
        """One finite number (kind float) or one boolean, from an array or a scalar."""
        number: Any = value
        if type(value) is not kind:
            array = self._call(f"step's {name}", np.asarray, value)
            fits = array.size == 1 and array.dtype.kind in "biuf"
            number = array.item() if fits else math.nan
        if not math.isfinite(number) or kind(number) != number:
            expected = "True or False" if kind is bool else "one finite real number"
            raise self._wrong("step", f"gave {name} {shown(value)}", expected)
        return kind(number)

    def _success(self, method: str, info: Any) -> bool:
        """Whether info reports a success; a rate, a text or None reports nothing."""
        if not isinstance(info, dict):
            raise self._wrong(method, f"gave info {shown(info)}", "a dict")
        for key in ("is_success", "success"):
            value = self._call(f"{method}'s info of {key}", np.asarray, info.get(key))
            if value.dtype.kind in "biuf" and np.isin(value, (0, 1)).all():
                self.reports = True
                return bool(value.all())
        return False


@storable
@dataclass(eq=False)
class SimulatedLanes(Lanes):
    """The lanes of a simulated task, counted in C order."""

    costly: ClassVar[bool] = True

    shape: tuple[int, ...] = (0,)  # the lanes' axes
    simulators: list[Simulator] = field(default_factory=list)

    def begin(self, start: Floats) -> Floats:
        """First observations (..., d) after resets by numbers (..., 1) in [0, 1)."""
        self.close()
        self.shape, self.failures = start.shape[:-1], {}
        self.simulators = [self.env.simulator() for _ in range(start[..., 0].size)]
        state = np.zeros((*self.shape, self.env.state_dim))
        return self.restart(np.ones(self.shape, bool), start, state)

    def step(self, state: Any, action: NDArray, noise: Any, lanes: Any = ...) -> tuple:
        """Observations, rewards, terminated and truncated of the chosen lanes."""
        otherwise = np.zeros(self.env.state_dim), 0.0, False, True
        pairs = zip(self._chosen(lanes), action.reshape(-1).tolist(), strict=True)
        found = [self._answer(lane, "step", each, otherwise) for lane, each in pairs]
        parts = map(np.array, zip(*found, strict=True))
        return tuple(x.reshape(*action.shape, *x.shape[1:]) for x in parts)

    def restart(self, over: Bools, start: Floats, state: Floats) -> Floats:
        """All observations; lanes that are over are reset."""
        state = state.copy()
        for place, lane in zip(np.argwhere(over), self._chosen(over), strict=True):
            number = float(start[tuple(place)][0])
            state[tuple(place)] = self._answer(lane, "reset", number, 0.0)
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
        numbers = np.arange(len(self.simulators)).reshape(self.shape)
        return numbers[lanes].reshape(-1).tolist()

    def _answer(self, lane: int, method: str, argument: float, otherwise: Any) -> Any:
        if lane not in self.failures:
            try:
                return getattr(self.simulators[lane], method)(argument)
            except BrokenSimulator as error:
                self.failures[lane] = str(error)
                self.simulators[lane].close()
        return otherwise


def vectors(space: Any) -> spaces.Space | None:
    """A space of vectors of one length, in float64 without bounds; None for others."""
    if isinstance(space, spaces.Box):
        return spaces.Box(-np.inf, np.inf, space.shape, np.float64)
    if isinstance(space, spaces.Dict):
        named: Any = [(key, vectors(part)) for key, part in space.items()]
        return None if any(part is None for _, part in named) else spaces.Dict(named)
    if isinstance(space, spaces.Tuple):
        parts: Any = list(map(vectors, space))
        return None if None in parts else spaces.Tuple(parts)
    numbered = (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
    return space if isinstance(space, numbered) else None


def _close(env: Any) -> None:
    with suppress(Exception):  # no result depends on it
        env.close()
