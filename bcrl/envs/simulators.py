"""Simulators whose every answer is checked, one by one or side by side."""

from __future__ import annotations

import math
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
from bcrl.envs._recipe import Recipe
from bcrl.envs.base import Bools, Floats
from bcrl.envs.checks import LARGEST, described
from bcrl.errors import BcrlError

_SEEDS = 2**31  # resets take seeds below: every 32-bit generator accepts them
_SUCCESS_KEYS = ("is_success", "success")  # of info
#: Spaces whose members become a vector without loss.
_PLAIN = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
#: Errors that end more than one simulator.
_PASSING = (BcrlError, Interrupted, KeyboardInterrupt, GeneratorExit)

#: Observation (d,), reward, terminated, truncated, and whether info reports success.
_Outcome = tuple[Floats, float, bool, bool, bool]


class BrokenSimulator(BcrlError):
    """A wrong answer of a simulator: names the method, the answer, what is expected."""


class Simulator:
    """A running environment; every wrong answer raises BrokenSimulator.

    `state_dim`: numbers in an observation; 0 takes those of the first one. `fresh`:
    every episode needs a new environment. The environment is closed at the latest when
    the simulator is deleted or the process exits.
    """

    close: weakref.finalize

    def __init__(
        self,
        recipe: Recipe,
        state_dim: int = 0,
        fresh: bool = False,
        render_mode: str | None = None,
    ) -> None:
        self.recipe, self.state_dim, self.fresh = recipe, state_dim, fresh
        self.render_mode = render_mode
        self.reports = False  # whether info has a success key
        self._map = recipe.mapping()
        self._open()

    def _open(self) -> None:
        env = self._call("the constructor", self.recipe.make, self.render_mode)
        self.env: gymnasium.Env = env
        self.close = weakref.finalize(self, _close, env)
        self._used = False
        self.space = self._call("observation_space", lambda: env.observation_space)
        self.actions = self._call("action_space", lambda: env.action_space)
        self._first_action: Any = getattr(self.actions, "start", 0)

    def reset(self, seed: int) -> Floats:
        """The first observation (d,) of an episode."""
        if self._used:
            if not self.fresh:
                with suppress(BrokenSimulator):
                    return self._reset(seed)
            self.close()  # it may allow no reset before the end of an episode
            self._open()
        return self._reset(seed)

    def _reset(self, seed: int) -> Floats:
        answer = self._call("reset", self.env.reset, seed=seed)
        seen, info = self._values("reset", answer, 2, "an observation and a dict")
        self._success("reset", info)
        first = self._vector("reset", seen)
        self._used = True
        return first

    def step(self, action: int) -> _Outcome:
        """The outcome of one step with an action counted from 0."""
        answer = self._call("step", self.env.step, action + self._first_action)
        names = "observation, reward, terminated, truncated and info"
        seen, reward, ended, cut, info = self._values("step", answer, 5, names)
        return (
            self._vector("step", seen),
            self._plain("reward", reward, float),
            self._plain("terminated", ended, bool),
            self._plain("truncated", cut, bool),
            self._success("step", info),
        )

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
            expected = "no error; mend the environment"
            if isinstance(error, ModuleNotFoundError) and error.name:
                package = error.name.partition(".")[0]
                expected = f"no error; pip install {package}, or mend the environment"
            if method == "reset":
                expected += " (reset(*, seed=None, options=None))"
            raise self.broken(method, f"raised {described(error)}", expected) from error

    def _values(self, method: str, answer: Any, count: int, names: str) -> Any:
        if isinstance(answer, (tuple, list)) and len(answer) == count:
            return answer
        expected = f"{count} values, {names}, as in Gymnasium 0.26 and later"
        raise self.broken(method, f"gave {_shown(answer)}", expected)

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
        parts = _parts(space)
        if parts is not None:
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
        expected = "real numbers" + (
            f", a member of {shortened(space)}" if space else ""
        )
        raise self.broken(method, f"gave {_shown(seen)}", expected)

    def _plain(self, name: str, value: Any, kind: type[float]) -> Any:
        """One finite number (kind float) or one boolean, from an array or a scalar."""
        if type(value) is kind and math.isfinite(value):
            return value
        array = self._call(f"step's {name}", np.asarray, value)
        allowed = _is_boolean(array) if kind is bool else _is_finite(array)
        if array.size != 1 or not allowed:
            expected = "True or False" if kind is bool else "one finite real number"
            raise self.broken("step", f"gave {name} {_shown(value)}", expected)
        return kind(array.item())

    def _success(self, method: str, info: Any) -> bool:
        """Whether info reports a success; a rate, a text or None reports nothing."""
        if not isinstance(info, dict):
            raise self.broken(
                method, f"gave info {_shown(info)}", "a dict as last value"
            )
        for key in _SUCCESS_KEYS:
            if key in info:
                value = self._call(f'{method}\'s info["{key}"]', np.asarray, info[key])
                if _is_boolean(value):
                    self.reports = True
                    return bool(value.all())
        return False


def _empty() -> NDArray:
    return np.empty(0)


@storable
@dataclass(eq=False)
class SimulatedLanes:
    """The `Lanes` of a simulated task, counted in C order: n of them.

    An episode follows from the number that reset its lane and the actions since. Only
    these are stored: lanes from a checkpoint play them again, and a lane fails if that
    leads elsewhere. A failed lane gives observations and rewards of 0.
    """

    env: Any  # a `Gymnasium`: recipe, state_dim, horizon, fresh
    shape: tuple[int, ...] = (0,)  # the lanes' axes
    start: Floats = field(default_factory=_empty)  # (n,) in [0, 1)
    taken: NDArray = field(default_factory=_empty)  # (n, horizon) actions, int16
    length: NDArray = field(default_factory=_empty)  # (n,) number of these actions
    seen: Floats = field(default_factory=_empty)  # (n, d) latest observations
    failures: dict[int, str] = field(default_factory=dict)
    running: list[Simulator | None] = field(default_factory=list, metadata=DERIVED)
    reported: list[bool] = field(default_factory=list, metadata=DERIVED)

    def begin(self, start: Floats) -> Floats:
        """First observations (..., d) after resets by numbers (..., 1) in [0, 1)."""
        self.close()
        self.shape, n = start.shape[:-1], start[..., 0].size
        self.start, self.failures = np.zeros(n), {}
        self.length = np.zeros(n, np.intp)
        self.taken = np.zeros((n, self.env.horizon), np.int16)
        self.seen = np.zeros((n, self.env.state_dim))
        self._open()
        state = self.seen.reshape(*self.shape, self.env.state_dim)
        return self.restart(np.ones(self.shape, bool), start, state)

    def step(
        self,
        state: Floats | None,
        action: NDArray,
        noise: Floats | None,
        lanes: Any = ...,
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Observations, rewards, terminated and truncated of the chosen lanes."""
        self._resume()
        chosen, acts = self._chosen(lanes), action.reshape(-1)
        self.taken[chosen, self.length[chosen]] = acts
        self.length[chosen] += 1
        n = len(chosen)
        after, reward = np.zeros((n, self.env.state_dim)), np.zeros(n)
        ended, cut = np.zeros(n, bool), np.ones(n, bool)
        for i, (lane, act) in enumerate(zip(chosen, acts.tolist(), strict=True)):
            if (found := self._answer(lane, "step", act)) is not None:
                after[i], reward[i], ended[i], cut[i], self.reported[lane] = found
        self.seen[chosen] = after
        shape = action.shape
        after = after.reshape(*shape, self.env.state_dim)
        return after, reward.reshape(shape), ended.reshape(shape), cut.reshape(shape)

    def restart(self, over: Bools, start: Floats, state: Floats) -> Floats:
        """All observations; lanes that are over are reset."""
        self._resume()
        chosen, state = self._chosen(over), state.copy()
        self.start[chosen], self.length[chosen] = start[over][:, 0], 0
        for lane in chosen:
            first = self._reset(lane)
            self.seen[lane] = 0.0 if first is None else first
        state[over] = self.seen[chosen]
        return state

    def close(self) -> None:
        """Close every simulator."""
        for simulator in filter(None, self.running):
            simulator.close()
        self.running = []

    @property
    def succeeded(self) -> Bools:
        """Whether the latest info of each lane reported success, (...)."""
        return np.array(self.reported, bool).reshape(self.shape)

    def _chosen(self, lanes: Any) -> list[int]:
        """The numbers of lanes that index the lanes' axes."""
        numbers = np.arange(len(self.length)).reshape(self.shape)
        return numbers[lanes].reshape(-1).tolist()

    def _open(self) -> None:
        n, env = len(self.length), self.env
        self.running, self.reported = [None] * n, [False] * n
        for lane in set(range(n)) - self.failures.keys():
            try:
                self.running[lane] = Simulator(env.recipe, env.state_dim, env.fresh)
            except BrokenSimulator as error:
                self.failures[lane] = str(error)

    def _answer(self, lane: int, method: str, argument: int) -> Any:
        """The answer of a lane's simulator; None from the time it has failed."""
        simulator = self.running[lane]
        if simulator is None:
            return None
        try:
            return getattr(simulator, method)(argument)
        except BrokenSimulator as error:
            self._fail(lane, simulator, error)
            return None

    def _fail(self, lane: int, simulator: Simulator, error: BrokenSimulator) -> None:
        self.failures[lane], self.running[lane] = str(error), None
        simulator.close()

    def _reset(self, lane: int) -> Floats | None:
        return self._answer(lane, "reset", reset_seed(self.start[lane]))

    def _resume(self) -> None:
        """Open lanes from a checkpoint and play their episodes again."""
        if self.running or not len(self.length):
            return
        self._open()
        for lane, length in enumerate(self.length.tolist()):
            now: Any = self._reset(lane)
            for action in self.taken[lane, :length].tolist():
                found = self._answer(lane, "step", action)
                now = None if found is None else found[0]
            simulator = self.running[lane]
            if simulator and not (now == self.seen[lane]).all():
                problem = f"gave another observation after {length} steps of a replay"
                expected = "the same after the same reset(seed=…) and actions"
                error = simulator.broken("step", problem, expected)
                self._fail(lane, simulator, error)


def reset_seed(number: float) -> int:
    """The seed of a reset for a number in [0, 1)."""
    return int(number * _SEEDS)


def is_plain(space: spaces.Space) -> bool:
    """Whether the members of a space can be flattened to a vector of fixed length."""
    parts = _parts(space)
    if parts is None:
        return isinstance(space, _PLAIN)
    return all(map(is_plain, parts.values()))


def shortened(value: Any) -> str:
    """The first 70 characters of a value in a message."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # of foreign code
        text = f"a {type(value).__name__}"
    return text if len(text) <= 70 else f"{text[:69]}…"


def _shown(value: Any) -> str:
    """A wrong value in a message, with its type."""
    if isinstance(value, (tuple, list)):
        return f"{len(value)} values: {shortened(value)}"
    if isinstance(value, np.ndarray) and value.ndim:
        return f"an array of shape {value.shape} and type {value.dtype}"
    return f"{shortened(value)} of type {type(value).__name__}"


def _parts(space: spaces.Space | None) -> dict[Any, spaces.Space] | None:
    """The spaces inside a Dict or Tuple by key or place; None for other spaces."""
    if isinstance(space, spaces.Dict):
        return space.spaces
    if isinstance(space, spaces.Tuple):
        return dict(enumerate(space.spaces))
    return None


def _is_finite(array: NDArray) -> bool:
    return array.dtype.kind in "biuf" and bool(np.isfinite(array).all())


def _is_boolean(array: NDArray) -> bool:
    """Whether all entries are booleans, or the numbers 0 and 1."""
    return array.dtype.kind in "biuf" and bool(((array == 0) | (array == 1)).all())


def _close(env: gymnasium.Env) -> None:
    with suppress(Exception):  # no result depends on it
        env.close()
