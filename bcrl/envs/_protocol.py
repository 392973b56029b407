"""Whether a pure environment of the user's keeps what the protocol asks for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bcrl.envs.base import Env
from bcrl.errors import ConfigError

LANES = (2, 3)  # leading axes of the states that it is tried on
NUMBERS = ("n_actions", "state_dim", "initial_noise", "step_noise")


def check(name: str, env: Env) -> None:
    """Try `initial`, `step` and `evaluation_states`; ConfigError for what is off."""

    def wrong(why: str) -> ConfigError:
        return ConfigError("env.name", name, why)

    for number in NUMBERS:
        value = getattr(env, number, None)
        if type(value) is not int or value < (0 if number.endswith("noise") else 1):
            raise wrong(f"{number} must be a number, is {value!r} (docs/own.md)")
    rng = np.random.default_rng(0)
    start = rng.random((*LANES, env.initial_noise))
    noise = rng.random((*LANES, env.step_noise))
    action = rng.integers(env.n_actions, size=LANES)
    state = _same(wrong, "initial", env.initial, start)
    shape = (*LANES, env.state_dim)
    _check(wrong, "initial: the states", state, shape, "fiu")
    state = np.asarray(state, np.float64)
    found = _same(wrong, "step", env.step, state, action, noise)
    if not isinstance(found, tuple) or len(found) != 3:
        raise wrong("step must give next states, rewards and what is absorbing")
    for what, value, expected, kinds in zip(
        ("states", "rewards", "absorbing"),
        found,
        (shape, LANES, LANES),
        ("fiu", "fiu", "b"),
        strict=True,
    ):
        _check(wrong, f"step: {what}", value, expected, kinds)
    states = _same(wrong, "evaluation_states", env.evaluation_states)
    _check(wrong, "evaluation_states", states, (len(states), env.state_dim), "fiu")


def _same(wrong: Callable, name: str, function: Callable, *arguments: Any) -> Any:
    """What a function gives, twice the same, its arguments left as they were."""
    before = [np.copy(argument) for argument in arguments]
    try:
        first, again = function(*arguments), function(*arguments)
    except Exception as error:  # whatever the user's code does
        raise wrong(f"{name} failed: {type(error).__name__}: {error}") from error
    if not all(map(np.array_equal, arguments, before)):
        raise wrong(f"{name} changes its arguments; it must make new arrays")
    pairs = zip(
        *[x if isinstance(x, tuple) else (x,) for x in (first, again)], strict=True
    )
    if not all(_alike(a, b) for a, b in pairs):
        why = "must depend on its arguments only; randomness comes in as noise"
        raise wrong(f"{name} gives something else the second time: it {why}")
    return first


def _alike(a: Any, b: Any) -> bool:
    """Whether two values are the same to the bit; what is no array is seen later."""
    a, b = np.asarray(a), np.asarray(b)
    return a.dtype.hasobject or a.tobytes() == b.tobytes()


def _check(wrong: Callable, what: str, value: Any, shape: tuple, kinds: str) -> None:
    """Raise unless it is an array of that shape, of numbers or booleans, finite."""
    found = getattr(value, "shape", None)
    if found != shape:
        raise wrong(f"{what} have shape {found}, expected {shape}")
    if value.dtype.kind not in kinds:
        noun = "booleans" if kinds == "b" else "numbers"
        raise wrong(f"{what} must be {noun}, are {value.dtype}")
    if kinds != "b" and not np.isfinite(value).all():
        raise wrong(f"{what} are not finite")
