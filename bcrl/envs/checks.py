"""Random play before any work: does an environment keep its contract?

Here are the checks that pure environments and simulators share, and the trial of a
user's pure environment. `gymnasium.py` has the trial of a simulator.
"""

import functools
import sys
import traceback
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bcrl.common.checks import one_of
from bcrl.common.terminal import say
from bcrl.envs.base import RULES, Env, Floats, check_episodes
from bcrl.errors import ConfigError

LARGEST = float(np.finfo(np.float32).max)  # learners see float32
RESOLUTION = 1e-7  # forests take values that differ by less for equal
LEVELS = 10_000  # a component with more distinct values is fine enough

_LANES = (16, 4)  # leading axes of the states in a pure environment's trial
_STEPS = 200  # of each of these episodes
#: Numbers that an environment needs, and the least value of each.
_NUMBERS = {"n_actions": 1, "state_dim": 1, "horizon": 1, "gamma": 0}
_NUMBERS |= {"initial_noise": 0, "step_noise": 0}
_LIBRARIES = ("bcrl", "gymnasium", "numpy")  # no place of an error in foreign code

#: Print a note, once per process.
once = functools.cache(say)


def described(error: BaseException) -> str:
    """An error of foreign code on one line, with its place as `…/file.py:12`."""
    frames = traceback.extract_tb(error.__traceback__)
    files = [f for f in frames if not f.filename.startswith("<")]
    loaded = [sys.modules[name] for name in _LIBRARIES if name in sys.modules]
    ours = {Path(module.__file__ or "").parent for module in loaded}
    foreign = [f for f in files if not ours & {*Path(f.filename).parents}]
    frame = (foreign or files)[-1]
    first_line = str(error).strip().partition("\n")[0][:200]
    place = f"…/{Path(frame.filename).name}:{frame.lineno}"
    return f"{type(error).__name__}: {first_line} ({place})"


def unresolved(seen: Floats) -> str:
    """The first component of states (n, d) whose values float32 or forests merge."""
    low, high = seen.min(0), seen.max(0)
    span, largest = high - low, np.maximum(np.abs(low), np.abs(high))
    fineness = np.maximum(np.spacing(largest.astype(np.float32)), RESOLUTION)
    for i in np.flatnonzero((span > 0) & (span < LEVELS * fineness)):
        steps = seen[:, i] - low[i]
        values = np.unique(np.round(steps / span[i] * 1e9))  # rounding errors merge
        if len(np.unique(np.round(steps / fineness[i]))) < len(values):
            where = f"component {i} of the observations lies within {low[i]:.10g} and "
            where += f"{high[i]:.10g}, where float32 and forests resolve "
            return f"{where}{fineness[i]:.2g}"
    return ""


def check_different(
    tasks: Sequence[Any],
    traces: Sequence[Sequence[Hashable]],
    episodes: int,
    allowed_by: str,
) -> None:
    """Raise ConfigError if successive tasks with equal traces should differ.

    `traces` has one value per step for each task, equal if nothing differs in it.
    """
    for number in range(1, len(tasks)):
        one, other = tasks[number - 1 : number + 1]
        same = (one.horizon, one.gamma) == (other.horizon, other.gamma)
        pairs: Any = zip(traces[number - 1], traces[number], strict=False)
        if same and all(a == b for a, b in pairs):
            names = getattr(one, "__dataclass_fields__", ())
            pairs = [(name, getattr(one, name), getattr(other, name)) for name in names]
            changes = [f"{name}: {a} → {b}" for name, a, b in pairs if a != b]
            why = f"tasks {number} and {number + 1} behave alike in {episodes} "
            why += "episodes of random play, so the parameter may have no effect "
            why += f"({allowed_by} accepts such tasks)"
            value = ", ".join(changes) or "the same task twice"
            raise ConfigError("env.tasks", value, why)


def check_pure_tasks(name: str, tasks: Sequence[Env]) -> None:
    """Try a user's tasks; ConfigError for a broken contract or for equal tasks."""
    traces = []
    for task in tasks:
        trace, states = _Trial(name, task).play()
        if note := unresolved(states):
            once(f"env.name={name}: {note}; let step and initial rescale it")
        traces.append(trace)
    if getattr(tasks[-1], "verify", True):
        allowed_by = f"verify = False in the class {type(tasks[-1]).__name__}"
        check_different(tasks, traces, int(np.prod(_LANES)), allowed_by)


@dataclass(frozen=True)
class _Trial:
    """Random episodes in one pure environment, whose every answer is checked."""

    name: str
    env: Env

    def play(self) -> tuple[list[Hashable], Floats]:
        """A trace of the episodes, and their states (n, d)."""
        self._check_constants()
        env, rng = self.env, np.random.default_rng(0)
        noise = rng.random((*_LANES, env.initial_noise))
        (state,) = self._answers("initial", noise, states=_LANES)
        self._answers("evaluation_states", states=(None,))
        states = [state]
        trace: list[Hashable] = [state.tobytes()]
        for _ in range(min(env.horizon, _STEPS)):
            lanes = state.shape[:-1]
            action = rng.integers(env.n_actions, size=lanes)
            noise = rng.random((*lanes, env.step_noise))
            gives = dict.fromkeys(("states", "rewards", "absorbing"), lanes)
            found = self._answers("step", state, action, noise, **gives)
            states.append(found[0])
            trace.append(tuple(part.tobytes() for part in found))
            state = found[0][~found[2]]
            if not state.size:
                break
        return trace, np.concatenate([s.reshape(-1, env.state_dim) for s in states])

    def _wrong(self, why: str) -> ConfigError:
        return ConfigError("env.name", self.name, f"{why} (docs/howto/own.md)")

    def _check_constants(self) -> None:
        env = self.env
        for key, least in _NUMBERS.items():
            value = getattr(env, key, None)
            if not isinstance(value, Real if key == "gamma" else int) or value < least:
                raise self._wrong(f"{key} is {value!r}, must be a number ≥ {least}")
        check_episodes(env.gamma, env.horizon)
        try:
            hash(env)
        except TypeError as error:
            why = "it must be a frozen dataclass of constants, and "
            raise self._wrong(f"{why}a tuple instead of a list ({error})") from error
        rule = getattr(env, "success", "unpunished")
        threshold = getattr(env, "success_threshold", None)
        one_of("success", rule, [rule for rule in RULES if rule != "info"])
        if rule == "threshold" and not isinstance(threshold, Real):
            why = "must be the return that counts as solved"
            raise self._wrong(f"success_threshold is {threshold!r}, {why}")

    def _answers(
        self, method: str, *arguments: NDArray, **gives: tuple[int | None, ...]
    ) -> list[NDArray]:
        """The arrays that a method returns, the same ones for the same arguments.

        `gives`: leading axes of each array by its noun; None stands for any length.
        """
        function = getattr(self.env, method)
        before = [argument.copy() for argument in arguments]
        try:
            answers = function(*arguments), function(*arguments)
        except (Exception, SystemExit) as error:
            raise self._wrong(f"{method} failed: {described(error)}") from error
        if not all(map(np.array_equal, arguments, before)):
            raise self._wrong(f"{method} changes its arguments; it must copy them")
        found, again = (x if isinstance(x, tuple) else (x,) for x in answers)
        if not len(found) == len(again) == len(gives):
            why = f"must give {', '.join(gives)} as a tuple"
            raise self._wrong(f"{method} gives {len(found)} values; it {why}")
        for (noun, lanes), one, other in zip(gives.items(), found, again, strict=True):
            self._check_array(f"{method}: {noun}", one, lanes)
            if not np.array_equal(one, other):
                why = "must depend on its arguments only; randomness comes in as noise"
                raise self._wrong(f"{method} gives other {noun} the second time; {why}")
            if one is other and one.flags.writeable:
                why = "gives one array again and again; it must make new ones"
                raise self._wrong(f"{method} {why}")
        dtypes = [bool if noun == "absorbing" else float for noun in gives]
        return [np.asarray(x, kind) for x, kind in zip(found, dtypes, strict=True)]

    def _check_array(self, what: str, value: Any, lanes: tuple) -> None:
        """Raise unless it is a finite array (lanes, …) of the right type."""
        shape = getattr(value, "shape", None)
        expected = (*lanes, self.env.state_dim) if what.endswith("states") else lanes
        if lanes == (None,) and shape and shape[0]:
            expected = (shape[0], *expected[1:])
        if shape != expected:
            raise self._wrong(f"{what} have shape {shape}, expected {expected}")
        boolean = what.endswith("absorbing")
        if getattr(value.dtype, "kind", "?") not in ("b" if boolean else "fiu"):
            noun = "booleans" if boolean else "numbers"
            raise self._wrong(f"{what} must be {noun}, are {value.dtype}")
        if not (np.abs(value) <= LARGEST).all():
            why = f"must be finite and at most {LARGEST:.3g} (float32's largest number)"
            raise self._wrong(f"{what} {why}")
