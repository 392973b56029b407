"""Whether a pure environment of the user's keeps what the protocol asks for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from bcrl.envs._contract import LARGEST, place_of
from bcrl.envs._success import RULES
from bcrl.envs._trial import coarse, once
from bcrl.envs.base import Env
from bcrl.errors import ConfigError, did_you_mean

LANES = (2, 3)  # leading axes of the states that it is tried on
EPISODES, STEPS = 64, 200  # in which two tasks have to differ
NUMBERS = ("n_actions", "state_dim", "initial_noise", "step_noise")


def check_tasks(name: str, tasks: Sequence[Env]) -> None:
    """Try every task; ConfigError for what is off, or for tasks that are alike."""
    traces = []
    for task in tasks:
        check(name, task)
        traces.append(_play(name, task))
        for text in coarse(np.concatenate([state for state, *_ in traces[-1]])):
            once(f"env.name={name}: {text}; let step and initial rescale it")
    for number, (one, other) in enumerate(pairwise(tasks), start=1):
        if not getattr(tasks[-1], "verify", True):
            return
        same = (one.horizon, one.gamma) == (other.horizon, other.gamma)
        pairs = zip(*traces[number - 1 : number + 1], strict=False)
        if same and all(all(map(np.array_equal, a, b)) for a, b in pairs):
            why = f"{one} and {other} behave alike in {EPISODES} episodes of random "
            why += "play, so what differs may not be applied (verify = False in the "
            why += f"class {type(one).__name__} if that is as it should be)"
            raise ConfigError("env.tasks", f"tasks {number} and {number + 1}", why)


def _play(name: str, env: Env) -> list[tuple]:
    """States, rewards and ends of random episodes side by side, each step's."""
    rng = np.random.default_rng(0)
    state = np.asarray(env.initial(rng.random((EPISODES, env.initial_noise))), float)
    trace = [(state,)]
    for _ in range(min(env.horizon, STEPS)):
        action = rng.integers(env.n_actions, size=len(state))
        noise = rng.random((len(state), env.step_noise))
        try:
            state, reward, absorbing = env.step(state, action, noise)
        except Exception as error:  # whatever the user's code does
            raise ConfigError("env.name", name, _raised("step", error)) from error
        if not (np.abs(state) <= LARGEST).all() or not np.isfinite(reward).all():
            why = "step gives states or rewards that are not finite in random play, or "
            why += f"states above {LARGEST:.3g} (float32's largest number)"
            raise ConfigError("env.name", name, why)
        trace.append((state, reward, absorbing))
        state = state[~absorbing]
        if not len(state):
            break
    return trace


def _raised(method: str, error: Exception) -> str:
    return f"{method} failed: {type(error).__name__}: {error} ({place_of(error)})"


def check(name: str, env: Env) -> None:
    """Try `initial`, `step` and `evaluation_states`; ConfigError for what is off."""

    def wrong(why: str) -> ConfigError:
        return ConfigError("env.name", name, why)

    for number in NUMBERS:
        value = getattr(env, number, None)
        if type(value) is not int or value < (0 if number.endswith("noise") else 1):
            raise wrong(f"{number} must be a number, is {value!r} (docs/own.md)")
    rules = [rule for rule in RULES if rule != "info"]
    if (rule := getattr(env, "success", "unpunished")) not in rules:
        raise wrong(f"success is {rule!r}; {did_you_mean(str(rule), rules)}")
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
        raise wrong(_raised(name, error)) from error
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
