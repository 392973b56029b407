"""How a simulator is made: a registered id, arguments, attributes and wrappers."""

import copy
import inspect
import sys
import warnings
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec, load_env_creator

from bcrl.common import plugins
from bcrl.errors import ConfigError, closest, did_you_mean

#: Gymnasium's wrappers that keep nothing beyond an episode and write no files.
WRAPPERS = (
    *("ClipAction", "ClipReward", "DelayObservation", "DiscretizeAction"),
    *("DiscretizeObservation", "FilterObservation", "FlattenObservation"),
    *("FrameStackObservation", "GrayscaleObservation", "MaxAndSkipObservation"),
    *("RescaleAction", "RescaleObservation", "ReshapeObservation"),
    *("ResizeObservation", "StickyAction"),
)
#: Packages whose import registers environments, and the beginnings of their ids; they
#: need no BCRL_TRUST. Their names for pip have hyphens.
PACKAGES: dict[str, tuple[str, ...]] = {
    "ale_py": ("ALE/",),
    "bcrl": (),
    "gymnasium": (),
    "gymnasium_robotics": ("Fetch", "Hand", "PointMaze", "AntMaze", "Adroit"),
    "highway_env": ("highway-", "merge-", "roundabout-", "parking-", "intersection-"),
    "minigrid": ("MiniGrid-", "BabyAI-"),
    "miniworld": ("MiniWorld-",),
    "shimmy": ("dm_control/", "bsuite/"),
}
_SET = {"max_episode_steps": -1, "disable_env_checker": True}  # arguments


@dataclass(frozen=True)
class Recipe:
    """`gymnasium.make(id, **kwargs)`, then `attributes`, then `wrappers` around it.

    `observation` names a trusted function `module.name` of an observation, or is None.
    """

    id: str
    kwargs: dict[str, Any] | None = None
    attributes: dict[str, Any] | None = None
    wrappers: list[Any] | None = None
    observation: str | None = None

    def __hash__(self) -> int:
        return hash(self.id)  # dicts have no hash

    def make(self, render_mode: str | None = None) -> gymnasium.Env:
        """A new environment without a time limit; ConfigError for a wrong key."""
        spec = spec_of(self.id)
        # Each simulator has its own lists, which it may change.
        kwargs, attributes = copy.deepcopy((self.kwargs or {}, self.attributes or {}))
        point = spec.entry_point
        creator = load_env_creator(point) if isinstance(point, str) else point
        mode = _checked("env.kwargs", creator, kwargs).get("render_mode")
        if render_mode or (mode and mode.default is inspect.Parameter.empty):
            kwargs["render_mode"] = "rgb_array"
        kwargs |= _SET
        with warnings.catch_warnings(), ExitStack() as undone:
            warnings.simplefilter("ignore", UserWarning)  # of precision, old versions
            env: gymnasium.Env = gymnasium.make(spec, **kwargs)
            undone.callback(env.close)
            for key, value in attributes.items():
                _set_attribute(env, key, value)
            for wrapper in copy.deepcopy(self.wrappers or ()):
                env = _wrapped(env, wrapper)
            undone.pop_all()
        return env


def spec_of(name: str) -> EnvSpec:
    """The environment `name`; `module:Name-v0` imports first; ConfigError if none."""
    module, _, plain = name.rpartition(":")
    there = module in sys.modules  # what it registers is known, too
    if module and not there and (module not in PACKAGES or find_spec(module)):
        plugins.module("env.id", name, module, PACKAGES)
    if plain in gymnasium.registry:
        return gymnasium.registry[plain]
    similar = closest(plain, gymnasium.registry)
    hint = f"did you mean env.id={similar}? " if similar else ""
    why = f"isn't registered; {hint}env.id=module:Name-v0 imports the module first"
    for owner, begins in PACKAGES.items():
        missing = find_spec(owner) is None
        named = owner == module
        if (named and missing) or (not named and plain.startswith(begins)):
            install = f"pip install {owner.replace('_', '-')}, then " if missing else ""
            why = f"{install}env.id={owner}:{plain} imports the package first"
    raise ConfigError("env.id", name, why)


def _checked(key: str, function: Any, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """A function's parameters; ConfigError for an argument unknown or set by bcrl."""
    try:
        parameters = dict(inspect.signature(function).parameters)
    except (TypeError, ValueError):  # it has no readable signature
        return {}
    known = [name for name in parameters if name not in (*_SET, "env")]
    anything = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    for name, value in arguments.items():
        if name in _SET or (name == "render_mode" and value != "rgb_array"):
            why = "is set by bcrl; only render_mode=rgb_array is allowed"
            raise ConfigError(f"{key}.{name}", value, why)
        if name not in known and not anything:
            why = did_you_mean(name, known) if known else "it takes no arguments"
            raise ConfigError(f"{key}.{name}", value, why)
    return parameters


def _set_attribute(env: gymnasium.Env, key: str, value: Any) -> None:
    """Set a plain attribute of the unwrapped environment that survives a reset."""
    there, place = env.unwrapped, f"env.attributes.{key}"
    plain = (bool, int, float, str, list, tuple, np.ndarray, np.number)
    members = inspect.getmembers_static(there, lambda member: isinstance(member, plain))
    known = {name: member for name, member in members if not name.startswith("_")}
    if key not in known:
        raise ConfigError(place, value, did_you_mean(key, known))
    before = known[key]
    old, new = np.asarray(before), np.asarray(value)
    kinds = {old.dtype.kind, new.dtype.kind}
    alike = np.isfinite(new).all() if kinds <= set("iuf") else kinds in ({"b"}, {"U"})
    if not alike or old.shape != new.shape:
        raise ConfigError(place, value, f"must be like {before!r}, and finite")
    if isinstance(before, np.ndarray):
        value = new.astype(old.dtype)
    elif isinstance(before, float):
        value = float(value)
    setattr(there, key, value)
    env.reset(seed=0)
    if not np.array_equal(getattr(there, key), value):
        why = f"is {getattr(there, key)} again after a reset; try env.kwargs"
        raise ConfigError(place, value, why)


def _wrapped(env: gymnasium.Env, wrapper: Any) -> gymnasium.Env:
    """`env` in a wrapper {name: …, arguments}; ConfigError if that is impossible."""
    if not isinstance(wrapper, dict) or not isinstance(wrapper.get("name"), str):
        why = "every wrapper needs a name: {name: RescaleObservation, min_obs: -1}"
        raise ConfigError("env.wrappers", wrapper, why)
    name = wrapper["name"].removeprefix("gymnasium.wrappers.")
    if "." in name:
        foreign = PACKAGES.keys() - {"bcrl", "gymnasium"}
        cls = plugins.attribute("env.wrappers", name, name, foreign)
        if not (isinstance(cls, type) and issubclass(cls, gymnasium.Wrapper)):
            raise ConfigError("env.wrappers", name, "must be a gymnasium.Wrapper")
    elif name in WRAPPERS and hasattr(gymnasium.wrappers, name):
        cls = getattr(gymnasium.wrappers, name)
    else:
        why = f"{did_you_mean(name, WRAPPERS)}, or module.Wrapper from a package"
        raise ConfigError("env.wrappers", name, why)
    items = ((k, tuple(v) if type(v) is list else v) for k, v in wrapper.items())
    given, place = {k: v for k, v in items if k != "name"}, f"env.wrappers.{name}"
    _checked(place, cls, given)
    try:
        return cls(env, **given)
    except Exception as error:  # of a wrapper's code
        raise ConfigError(place, given, f"{type(error).__name__}: {error}") from error
