"""Gymnasium environments, made from ids, arguments, attributes and wrappers."""

from __future__ import annotations

import copy
import importlib.util
import inspect
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import (
    EnvSpec,
    get_env_id,
    load_env_creator,
    parse_env_id,
)

from bcrl.common import plugins
from bcrl.errors import ConfigError, did_you_mean, guess

#: Gymnasium's wrappers that keep nothing beyond an episode and write nothing.
WRAPPERS = (
    *("ClipAction", "ClipReward", "DelayObservation", "DiscretizeAction"),
    *("DiscretizeObservation", "FilterObservation", "FlattenObservation"),
    *("FrameStackObservation", "GrayscaleObservation", "MaxAndSkipObservation"),
    *("RescaleAction", "RescaleObservation", "ReshapeObservation"),
    *("ResizeObservation", "StickyAction"),
)
#: Arguments of `gymnasium.make` itself.
OURS = ("max_episode_steps", "disable_env_checker")
#: Packages whose import registers environments; no BCRL_TRUST is needed for them.
#: By module: what pip calls the package, and how its ids begin.
PACKAGES = {
    "ale_py": ("ale-py", ("ALE/",)),
    "bcrl": ("boosted-curriculum-rl", ("bcrl/",)),
    "gymnasium": ("gymnasium", ()),
    "gymnasium_robotics": (
        "gymnasium-robotics",
        ("Fetch", "HandReach", "HandManipulate", "PointMaze", "AntMaze", "Adroit"),
    ),
    "highway_env": (
        "highway-env",
        ("highway-", "merge-", "roundabout-", "parking-", "intersection-"),
    ),
    "minigrid": ("minigrid", ("MiniGrid-", "BabyAI-")),
    "miniworld": ("miniworld", ("MiniWorld-",)),
    "shimmy": ("shimmy", ("dm_control/", "bsuite/")),
}


def spec_of(name: str) -> EnvSpec:
    """The registered environment `name`; ConfigError if there is none.

    `module:Name-v0` imports the module first: one of PACKAGES, or of BCRL_TRUST's.
    """
    module, colon, name_there = name.rpartition(":")
    if colon:
        if module in PACKAGES and not importlib.util.find_spec(module):
            why = f"isn't installed: pip install {PACKAGES[module][0]}"
            raise ConfigError("env.id", name, f"the package {module} {why}")
        plugins.module("env.id", name, module, PACKAGES)
    if name_there not in gymnasium.registry:
        raise ConfigError("env.id", name, _meant(name_there))
    return gymnasium.registry[name_there]


def _meant(name: str) -> str:
    """What an id that isn't registered may mean."""
    for module, (package, begins) in PACKAGES.items():
        if name.startswith(begins) and module != "bcrl":
            missing = not importlib.util.find_spec(module)
            first = f"pip install {package}, then " * missing
            return f"{first}env.id={module}:{name} imports what registers it"
    try:
        space, base, _ = parse_env_id(name)
    except gymnasium.error.Error:
        space = base = None
    versions = [
        spec
        for spec in gymnasium.registry.values()
        if (spec.namespace, spec.name.lower()) == (space, str(base).lower())
    ]
    if versions:
        newest = max(versions, key=lambda spec: spec.version or 0)
        found = get_env_id(newest.namespace, newest.name, newest.version)
        return f"isn't registered; the newest version here is env.id={found}"
    known = [n for n in gymnasium.registry if not n.startswith(("phys2d", "tabular"))]
    text = "env.id=module:Name-v0 imports the module that registers it"
    return f"isn't registered; {guess(name, known)} {text}".replace("  ", " ")


def max_steps(name: str) -> int | None:
    """The number of steps after which the registered environment is truncated."""
    return spec_of(name).max_episode_steps


def made(
    name: str,
    kwargs: Mapping,
    attributes: Mapping,
    wrappers: Sequence,
    render_mode: str | None = None,
) -> gymnasium.Env:
    """The environment, without a time limit; ConfigError for what it doesn't take."""
    spec = spec_of(name)
    # Each simulator has its own: whoever changes a list changes no other's.
    kwargs, attributes, wrappers = copy.deepcopy((kwargs, attributes, wrappers))
    creator = _creator(spec)
    _check_arguments("env.kwargs", kwargs, creator)
    given = kwargs.pop("render_mode", None)
    if render_mode or given or _needs_mode(creator):
        kwargs["render_mode"] = "rgb_array"
    with warnings.catch_warnings():  # of precision and of old versions, each time
        warnings.simplefilter("ignore", UserWarning)
        limits = {"max_episode_steps": -1, "disable_env_checker": True}
        env = gymnasium.make(spec, **limits, **kwargs)
        try:
            for key, value in attributes.items():
                _set(env, key, value)
            for wrapper in wrappers:
                env = _wrapped(env, wrapper)
        except BaseException:
            env.close()
            raise
    return env


def _creator(spec: EnvSpec) -> Any:
    point = spec.entry_point
    return load_env_creator(point) if isinstance(point, str) else point


def _parameters(made: Any) -> list[inspect.Parameter]:
    try:
        return list(inspect.signature(made).parameters.values())
    except (TypeError, ValueError):  # it has none that can be read
        return [inspect.Parameter("any", inspect.Parameter.VAR_KEYWORD)]


def _needs_mode(made: Any) -> bool:
    """Whether a constructor can't be called without a render_mode."""
    found = [p for p in _parameters(made) if p.name == "render_mode"]
    return bool(found) and found[0].default is inspect.Parameter.empty


def _check_arguments(key: str, arguments: Mapping, made: Any, first: int = 0) -> None:
    """Raise ConfigError for a keyword that `made` doesn't take, or that is ours."""
    parameters = _parameters(made)[first:]
    known = [p.name for p in parameters if p.name not in OURS]
    anything = any(p.kind is p.VAR_KEYWORD for p in parameters)
    for argument, value in arguments.items():
        if argument in OURS or (argument == "render_mode" and value != "rgb_array"):
            why = "is set by bcrl; render_mode may be rgb_array, and nothing else"
            raise ConfigError(f"{key}.{argument}", value, why)
        if argument not in known and not anything:
            why = did_you_mean(argument, known) if known else "it takes no arguments"
            raise ConfigError(f"{key}.{argument}", value, why)


def _set(env: gymnasium.Env, key: str, value: Any) -> None:
    """Set an attribute that is a plain value, and see that it lasts."""
    plain = (bool, int, float, str, list, tuple, np.ndarray, np.number)
    there = env.unwrapped
    known = [
        name
        for name in dir(there)
        if not name.startswith("_") and isinstance(_plainly(there, name), plain)
    ]
    if key not in known:
        raise ConfigError(f"env.attributes.{key}", value, did_you_mean(key, known))
    before = getattr(there, key)
    kinds = (bool, str, (int, float, np.number), (list, tuple, np.ndarray))
    kind = next(k for k in kinds if isinstance(before, k))
    boolean = isinstance(value, bool) != (kind is bool)
    if boolean or not isinstance(value, kind) or np.shape(value) != np.shape(before):
        raise ConfigError(f"env.attributes.{key}", value, f"must be like {before!r}")
    if kind is not str and not np.isfinite(value).all():
        raise ConfigError(f"env.attributes.{key}", value, "must be finite")
    if isinstance(before, np.ndarray):
        value = np.array(value, before.dtype)
    elif isinstance(before, float):
        value = float(value)
    setattr(there, key, value)
    env.reset(seed=0)
    if not np.array_equal(getattr(there, key), value):
        why = f"is {getattr(there, key)} again after a reset; try env.kwargs"
        raise ConfigError(f"env.attributes.{key}", value, why)


def _plainly(thing: Any, name: str) -> Any:
    """An attribute that isn't computed, or None."""
    if isinstance(getattr(type(thing), name, None), property):
        return None
    return getattr(thing, name, None)


def _wrapped(env: gymnasium.Env, wrapper: Any) -> gymnasium.Env:
    """`env` in a wrapper {name: …, arguments}; ConfigError for one that can't be."""
    if not isinstance(wrapper, dict) or not isinstance(wrapper.get("name"), str):
        why = "every wrapper needs a name: {name: RescaleObservation, min_obs: -1}"
        raise ConfigError("env.wrappers", wrapper, why)
    arguments = {k: v for k, v in wrapper.items() if k != "name"}
    name = wrapper["name"].removeprefix("gymnasium.wrappers.")
    if "." in name:
        foreign = PACKAGES.keys() - {"bcrl", "gymnasium"}
        cls = plugins.attribute("env.wrappers", name, name, foreign)
        if not (isinstance(cls, type) and issubclass(cls, gymnasium.Wrapper)):
            raise ConfigError("env.wrappers", name, "must be a gymnasium.Wrapper")
    elif name in WRAPPERS and hasattr(gymnasium.wrappers, name):
        cls = getattr(gymnasium.wrappers, name)
    else:
        why = f"{did_you_mean(name, WRAPPERS)}, or module.Wrapper of your own"
        raise ConfigError("env.wrappers", name, why)
    _check_arguments(f"env.wrappers.{name}", arguments, cls.__init__, 2)
    tuples = {k: tuple(v) if type(v) is list else v for k, v in arguments.items()}
    try:
        return cls(env, **tuples)
    except Exception as error:  # whatever a wrapper does
        why = f"can't wrap it: {type(error).__name__}: {error}"
        raise ConfigError(f"env.wrappers.{name}", arguments, why) from error
