"""Whether a pure environment of the user's keeps what the protocol asks for."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from itertools import pairwise
from numbers import Real
from typing import Any

import numpy as np

from bcrl.envs._contract import LARGEST, place_of
from bcrl.envs._success import RULES
from bcrl.envs._trial import coarse, once
from bcrl.envs.base import Env
from bcrl.errors import ConfigError, did_you_mean

LANES = (2, 3)  # leading axes of the states that it is tried on
EPISODES, STEPS = 64, 200  # in which two tasks have to differ
NUMBERS = ("n_actions", "state_dim", "horizon", "initial_noise", "step_noise")


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

    def wrong(why: str) -> ConfigError:
        return ConfigError("env.name", name, why)

    rng = np.random.default_rng(0)
    state = np.asarray(env.initial(rng.random((EPISODES, env.initial_noise))), float)
    trace = [(state,)]
    for _ in range(min(env.horizon, STEPS)):
        action = rng.integers(env.n_actions, size=len(state))
        noise = rng.random((len(state), env.step_noise))
        state, reward, absorbing = _same(wrong, "step", env.step, state, action, noise)
        if not (np.abs(state) <= LARGEST).all() or not np.isfinite(reward).all():
            why = "step gives states or rewards that are not finite in random play, or "
            raise wrong(f"{why}states above {LARGEST:.3g} (float32's largest number)")
        trace.append((state, reward, absorbing))
        state = state[~absorbing]
        if not len(state):
            break
    return trace


def _raised(method: str, error: BaseException) -> str:
    return f"{method} failed: {type(error).__name__}: {error} ({place_of(error)})"


def check(name: str, env: Env) -> None:
    """Try `initial`, `step` and `evaluation_states`; ConfigError for what is off."""

    def wrong(why: str) -> ConfigError:
        return ConfigError("env.name", name, why)

    for number in NUMBERS:
        value = getattr(env, number, None)
        if type(value) is not int or value < (0 if number.endswith("noise") else 1):
            raise wrong(f"{number} must be a number, is {value!r} (docs/own.md)")
    gamma = getattr(env, "gamma", None)
    if not isinstance(gamma, Real) or not 0.0 <= gamma < 1.0:
        raise wrong(f"gamma must be a number in [0, 1), is {gamma!r}")
    try:
        hash(env)
    except TypeError as error:
        why = "must be a frozen dataclass of values that never change, which "
        raise wrong(f"{why}tuple[float, ...] takes from a list ({error})") from error
    rules = [rule for rule in RULES if rule != "info"]
    if (rule := getattr(env, "success", "unpunished")) not in rules:
        raise wrong(f"success is {rule!r}; {did_you_mean(str(rule), rules)}")
    threshold = getattr(env, "success_threshold", None)
    if rule == "threshold" and not isinstance(threshold, Real):
        why = "must be the return that counts as solved"
        raise wrong(f"success_threshold {why}, is {threshold!r}")
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
    n = len(states) if np.ndim(states) else 0
    _check(wrong, "evaluation_states", states, (max(n, 1), env.state_dim), "fiu")


def _same(wrong: Callable, name: str, function: Callable, *arguments: Any) -> Any:
    """What a function gives, twice the same, its arguments left as they were."""
    before = [np.copy(argument) for argument in arguments]
    try:
        first = function(*arguments)
        kept, again = copy.deepcopy(first), function(*arguments)
    except (Exception, SystemExit) as error:  # whatever the user's code does
        raise wrong(_raised(name, error)) from error
    if not all(map(np.array_equal, arguments, before)):
        raise wrong(f"{name} changes its arguments; it must make new arrays")
    found = [x if isinstance(x, tuple) else (x,) for x in (kept, again)]
    if len(found[0]) != len(found[1]) or not all(map(_alike, *found)):
        why = "must depend on its arguments only; randomness comes in as noise"
        raise wrong(f"{name} gives something else the second time: it {why}")
    outputs = zip(first, again, strict=True) if isinstance(first, tuple) else ()
    shared = (a is b and getattr(a, "flags", None) for a, b in outputs)
    if any(flags and flags.writeable for flags in shared):
        raise wrong(f"{name} gives one array again and again; it must make new ones")
    return first


def _alike(a: Any, b: Any) -> bool:
    """Whether two values are the same to the bit; what is no array is seen later."""
    try:
        a, b = np.asarray(a), np.asarray(b)
    except ValueError:  # no array can be made of it
        return True
    return a.dtype.hasobject or a.tobytes() == b.tobytes()


def _check(wrong: Callable, what: str, value: Any, shape: tuple, kinds: str) -> None:
    """Raise unless it is an array of that shape, of numbers or booleans, finite."""
    found = getattr(value, "shape", None)
    if found != shape:
        raise wrong(f"{what} have shape {found}, expected {shape}")
    if getattr(value.dtype, "kind", None) not in kinds:  # of other libraries, too
        noun = "booleans" if kinds == "b" else "numbers"
        raise wrong(f"{what} must be {noun}, are {value.dtype}")
    if kinds != "b" and not np.isfinite(value).all():
        raise wrong(f"{what} are not finite")
