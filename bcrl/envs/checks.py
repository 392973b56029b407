"""Random play before any work; `gymnasium.py` has the trial of a simulator."""

import copy
import functools
import itertools
import reprlib
import sys
import traceback
from collections.abc import Sequence
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
_NUMBERS = {"n_actions": 1, "state_dim": 1, "initial_noise": 0, "step_noise": 0}

#: Print a note, once per process.
once = functools.cache(say)


def described(error: BaseException) -> str:
    """An error of foreign code on one line, with its place as `…/file.py:12`."""
    frames = traceback.extract_tb(error.__traceback__)
    files = [f for f in frames if not f.filename.startswith("<")]
    libraries = map(sys.modules.get, ("bcrl", "gymnasium", "numpy"))
    ours = {Path(module.__file__ or "").parent for module in libraries if module}
    foreign = [f for f in files if not ours & {*Path(f.filename).parents}]
    frame = (foreign or files)[-1]
    said, name = str(error).strip().partition("\n")[0][:200], Path(frame.filename).name
    return f"{type(error).__name__}: {said} (…/{name}:{frame.lineno})"


def shown(value: Any) -> str:
    """A wrong value in a message, on one short line, with its type."""
    if isinstance(value, np.ndarray) and value.ndim:
        return f"an array of shape {value.shape} and type {value.dtype}"
    return f"{' '.join(reprlib.repr(value).split())} of type {type(value).__name__}"


def unresolved(seen: Floats) -> str:
    """The first component of states (n, d) whose values float32 or forests merge."""
    low, high = seen.min(0), seen.max(0)
    span, largest = high - low, np.maximum(np.abs(low), np.abs(high))
    fineness = np.maximum(np.spacing(largest.astype(np.float32)), RESOLUTION)
    for i in np.flatnonzero((span > 0) & (span < LEVELS * fineness)):
        steps = seen[:, i] - low[i]
        values = np.unique(np.round(steps / span[i] * 1e9))  # rounding errors merge
        if len(np.unique(np.round(steps / fineness[i]))) < len(values):
            found = f"component {i} of the observations lies within {low[i]:.10g} and "
            found += f"{high[i]:.10g}, where float32 and forests resolve "
            return f"{found}{fineness[i]:.2g}"
    return ""


def check_different(tasks: Sequence, traces: Sequence, allowed_by: str) -> None:
    """Raise ConfigError if successive tasks have equal traces, one value per step."""
    pairs = itertools.pairwise(zip(tasks, traces, strict=True))
    for number, ((one, seen), (other, again)) in enumerate(pairs, 1):
        same = (one.horizon, one.gamma) == (other.horizon, other.gamma)
        if same and all(a == b for a, b in zip(seen, again, strict=False)):
            changes = [
                f"{name}: {getattr(one, name)} → {getattr(other, name)}"
                for name in getattr(one, "__dataclass_fields__", ())
                if getattr(one, name) != getattr(other, name)
            ]
            why = f"tasks {number} and {number + 1} behave alike in random play; "
            why += f"if they should, {allowed_by} accepts them"
            raise ConfigError("env.tasks", ", ".join(changes) or "equal", why)


def check_pure_tasks(name: str, tasks: Sequence[Env]) -> None:
    """Try a user's tasks; ConfigError for a broken contract or for equal tasks."""
    traces = []
    for task in tasks:
        try:
            trace, states = _trial(task)
        except ConfigError:
            raise
        except (Exception, SystemExit) as error:
            why = str(error) if isinstance(error, _Broken) else described(error)
            raise ConfigError("env.name", name, f"{why} (docs/howto/own.md)") from error
        if note := unresolved(states):
            once(f"env.name={name}: {note}; let step and initial rescale it")
        traces.append(trace)
    if getattr(tasks[-1], "verify", True):
        allowed_by = f"verify = False in the class {type(tasks[-1]).__name__}"
        check_different(tasks, traces, allowed_by)


class _Broken(Exception):
    """What an environment does against its contract."""


def _require(kept: bool | np.bool_, why: str) -> None:
    if not kept:
        raise _Broken(why)


def _trial(env: Env) -> tuple[list[tuple[bytes, ...]], Floats]:
    """The trace of random episodes whose every answer is checked, and states (n, d)."""
    for key, least in _NUMBERS.items():
        value = getattr(env, key, None)
        fits = isinstance(value, int) and value >= least
        _require(fits, f"{key} is {value!r}, must be a number ≥ {least}")
    check_episodes(env.gamma, env.horizon)
    rule = getattr(env, "success", "unpunished")
    one_of("success", rule, RULES[:-1])  # without info
    threshold = getattr(env, "success_threshold", None)
    why = f"success_threshold is {threshold!r}, must be the return of a solved episode"
    _require(rule != "threshold" or isinstance(threshold, Real), why)
    try:
        hash(env)
    except TypeError as error:
        why = "it must be a frozen dataclass of constants, a tuple instead of a list"
        raise _Broken(f"{why} ({error})") from error
    rng = np.random.default_rng(0)
    (state,) = _answers(env, "initial", rng.random((*_LANES, env.initial_noise)))
    _answers(env, "evaluation_states")
    states = [state]
    trace: list[tuple[bytes, ...]] = [(state.tobytes(),)]
    for _ in range(min(env.horizon, _STEPS)):
        lanes = state.shape[:-1]
        action = rng.integers(env.n_actions, size=lanes)
        noise = rng.random((*lanes, env.step_noise))
        found = _answers(env, "step", state, action, noise)
        states.append(found[0])
        trace.append(tuple(part.tobytes() for part in found))
        state = found[0][~found[2]]
        if not state.size:
            break
    return trace, np.concatenate([s.reshape(-1, env.state_dim) for s in states])


def _answers(env: Env, method: str, *arguments: NDArray) -> list[NDArray]:
    before = [argument.copy() for argument in arguments]
    given = getattr(env, method)(*arguments)
    kept = copy.deepcopy(given)  # the second answer may be a view of the same buffer
    again = getattr(env, method)(*arguments)
    same = all(map(np.array_equal, arguments, before))
    _require(same, f"{method} changes its arguments; it must copy them")
    nouns = ("states", "rewards", "absorbing") if method == "step" else ("states",)
    raws, firsts, seconds = (
        x if isinstance(x, tuple) else (x,) for x in (given, kept, again)
    )
    why = f"{method} gives {len(firsts)} values; it must give {', '.join(nouns)}"
    _require(len(firsts) == len(seconds) == len(nouns), why)
    found = []
    for noun, raw, first, second in zip(nouns, raws, firsts, seconds, strict=True):
        shape, dtype = getattr(first, "shape", None), getattr(first, "dtype", None)
        lanes = arguments[0].shape[:-1] if arguments else (shape or (1,))[:1]
        expected = (*lanes, env.state_dim) if noun == "states" else lanes
        kinds, words = ("b", "booleans") if noun == "absorbing" else ("fiu", "numbers")
        why = f"{method}: {noun} have shape {shape} and type {dtype}, "
        why += f"expected {words} of shape {expected}"
        _require(shape == expected and getattr(dtype, "kind", "?") in kinds, why)
        _require(0 not in expected, f"{method}: there are no {noun}")
        why = f"{method}: {noun} must be finite and at most {LARGEST:.3g} (float32)"
        _require((np.abs(first) <= LARGEST).all(), why)
        why = f"{method} gives other {noun} the second time; use noise for randomness"
        _require(np.array_equal(first, second), why)
        why = f"{method} gives one array again and again; it must make new ones"
        _require(raw is not second or not raw.flags.writeable, why)
        found.append(np.asarray(first, bool if noun == "absorbing" else float))
    return found
