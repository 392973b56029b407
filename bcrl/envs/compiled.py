"""A step that is written for one state, compiled into a loop over many."""

import functools
import re
from collections.abc import Callable
from types import FunctionType
from typing import Any

import numpy as np

from bcrl.common.arrays import writable
from bcrl.common.compiling import kept
from bcrl.envs.base import Floats, Ints, Step


def compiled_step(one: Callable) -> Callable[..., Step]:
    """A decorator that turns a step of one state into a step of arrays.

    `one(state, action, noise, *constants)` gets a state (d,), an action's number, noise
    (k,) and the constants: numbers, tuples or arrays. It returns the next state as a
    tuple of d floats, the reward, and whether the next state is absorbing. numba
    compiles it. The new step has the same arguments, but takes and gives arrays with
    any leading axes, as `Env.step` does. Noise may be None if `one` needs none. Raises
    TypeError if numba cannot compile `one`.
    """
    options = {"nogil": True, "error_model": "numpy"}
    loop = kept(_loop_over(one, kept(one, **options)), **options)

    @functools.wraps(one)
    def step(state: Floats, action: Ints, noise: Any, *constants: Any) -> Step:
        state, action = np.asarray(state), np.asarray(action)
        noise = np.empty((*action.shape, 0)) if noise is None else noise
        lead = state.shape[:-1]
        if not lead == action.shape == noise.shape[:-1]:  # rare; it takes some time
            lead = np.broadcast_shapes(lead, action.shape, noise.shape[:-1])
            state = np.broadcast_to(state, (*lead, state.shape[-1]))
            noise = np.broadcast_to(noise, (*lead, noise.shape[-1]))
            action = np.broadcast_to(action, lead)
        n, d = action.size, state.shape[-1]
        given = writable(state).reshape(n, d), np.array(action, np.int64).reshape(n)
        after, reward, absorbing = np.empty((n, d)), np.empty(n), np.empty(n, np.bool_)
        random = writable(noise).reshape(n, noise.shape[-1])
        try:
            loop(*given, random, after, reward, absorbing, *constants)
        except Exception as error:
            from numba.core.errors import NumbaError  # a large import

            if not isinstance(error, NumbaError):
                raise
            why = f"numba cannot compile {one.__qualname__}: {_reason(error)}"
            raise TypeError(why) from error
        return after.reshape(*lead, d), reward.reshape(lead), absorbing.reshape(lead)

    return step


one: Any = None  # each copy of `_loop` has its own


def _loop(state, action, noise, after, reward, absorbing, *constants):
    """Fill `after` (n, d), `reward` and `absorbing` (n,), one call of `one` per row."""
    for i in range(len(state)):
        found = one(state[i], action[i], noise[i], *constants)
        after[i], reward[i], absorbing[i] = found


def _loop_over(function: Callable, one: Any) -> Callable:
    """`_loop` with its own `one`, whose compiled code is kept beside `function`'s."""
    path, line = function.__code__.co_filename, function.__code__.co_firstlineno
    code = _loop.__code__.replace(co_filename=path, co_firstlineno=line)
    loop = FunctionType(code, {"one": one}, _loop.__name__)
    loop.__module__ = function.__module__
    loop.__qualname__ = f"{function.__qualname__}.loop"
    return loop


def _reason(error: Exception) -> str:
    """The first two lines that say something in numba's long message, and the place."""
    lines = re.sub(r"\x1b\[\d*m", "", str(error)).splitlines()
    said = [line.strip() for line in lines if line.strip()]
    said = [line for line in said if not line.startswith(("Failed in", "- "))]
    places = re.findall(r'File "[^"]*?([^/"]+)", line (\d+)', str(error))
    place = f" (…/{places[0][0]}:{places[0][1]})" if places else ""
    return " ".join(said[:2]) + place
