"""How a simulator is made: a registered id, arguments, attributes and wrappers."""

from __future__ import annotations

import copy
import importlib.util
import inspect
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
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
_RESERVED = ("max_episode_steps", "disable_env_checker")  # arguments that bcrl sets


@dataclass(frozen=True)
class Recipe:
    """`gymnasium.make(id, **kwargs)`, then `attributes`, then `wrappers` around it.

    `observation` names a trusted function `module.name` of an observation, or is None.
    """

    id: str
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    attributes: Mapping[str, Any] = field(default_factory=dict)
    wrappers: tuple[Any, ...] = ()
    observation: str | None = None

    def __hash__(self) -> int:
        return hash(self.id)  # dicts have no hash

    def make(self, render_mode: str | None = None) -> gymnasium.Env:
        """A new environment without a time limit; ConfigError for a wrong key."""
        spec = spec_of(self.id)
        # A copy for each simulator: one that changes a list changes no other's.
        kwargs: dict = copy.deepcopy(dict(self.kwargs))
        attributes, wrappers = copy.deepcopy((self.attributes, self.wrappers))
        point = spec.entry_point
        creator = load_env_creator(point) if isinstance(point, str) else point
        parameters = _parameters(creator)
        _check_arguments("env.kwargs", kwargs, parameters)
        mode = parameters.get("render_mode")
        if render_mode or (mode and mode.default is inspect.Parameter.empty):
            kwargs["render_mode"] = "rgb_array"
        with warnings.catch_warnings():  # about precision and old versions
            warnings.simplefilter("ignore", UserWarning)
            env: gymnasium.Env = gymnasium.make(
                spec, max_episode_steps=-1, disable_env_checker=True, **kwargs
            )
            try:
                for key, value in attributes.items():
                    _set_attribute(env, key, value)
                for wrapper in wrappers:
                    env = _wrapped(env, wrapper)
            except BaseException:
                env.close()
                raise
        return env

    def mapping(self) -> Callable[[Any], Any] | None:
        """The function `observation`; ConfigError if it isn't trusted or missing."""
        if self.observation is None:
            return None
        name = str(self.observation)
        return plugins.attribute("env.observation", name, name)


def spec_of(name: str) -> EnvSpec:
    """The registered environment `name`; ConfigError if there is none.

    `module:Name-v0` imports the module first: one of PACKAGES or of BCRL_TRUST.
    """
    module, colon, name_there = name.rpartition(":")
    if colon:
        if module in PACKAGES and not importlib.util.find_spec(module):
            why = f"the package {module} isn't installed: {_pip(module)}"
            raise ConfigError("env.id", name, why)
        plugins.module("env.id", name, module, PACKAGES)
    if name_there in gymnasium.registry:
        return gymnasium.registry[name_there]
    for module, beginnings in PACKAGES.items():
        if name_there.startswith(beginnings):
            missing = not importlib.util.find_spec(module)
            first = f"{_pip(module)}, then " if missing else ""
            why = f"{first}env.id={module}:{name_there} imports the package first"
            raise ConfigError("env.id", name, why)
    similar = closest(name_there, gymnasium.registry)
    hint = f"did you mean env.id={similar}? " if similar else ""
    why = f"isn't registered; {hint}env.id=module:Name-v0 imports the module first"
    raise ConfigError("env.id", name, why)


def _pip(module: str) -> str:
    return f"pip install {module.replace('_', '-')}"


def _parameters(creator: Any) -> dict[str, inspect.Parameter]:
    try:
        return dict(inspect.signature(creator).parameters)
    except (TypeError, ValueError):  # it has no readable signature
        return {"any": inspect.Parameter("any", inspect.Parameter.VAR_KEYWORD)}


def _check_arguments(
    key: str, arguments: Mapping[str, Any], parameters: dict[str, inspect.Parameter]
) -> None:
    """Raise ConfigError for a keyword that is unknown or that bcrl sets."""
    known = [name for name in parameters if name not in _RESERVED]
    anything = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    for name, value in arguments.items():
        if name in _RESERVED or (name == "render_mode" and value != "rgb_array"):
            why = "is set by bcrl; only render_mode=rgb_array is allowed"
            raise ConfigError(f"{key}.{name}", value, why)
        if name not in known and not anything:
            why = did_you_mean(name, known) if known else "it takes no arguments"
            raise ConfigError(f"{key}.{name}", value, why)


def _set_attribute(env: gymnasium.Env, key: str, value: Any) -> None:
    """Set a plain attribute of the unwrapped environment that survives a reset."""
    plain = (bool, int, float, str, list, tuple, np.ndarray, np.number)
    there, place = env.unwrapped, f"env.attributes.{key}"
    known = [
        name
        for name in dir(there)
        if not name.startswith("_")
        and not isinstance(getattr(type(there), name, None), property)
        and isinstance(getattr(there, name, None), plain)
    ]
    if key not in known:
        raise ConfigError(place, value, did_you_mean(key, known))
    before = getattr(there, key)
    old, new = np.asarray(before), np.asarray(value)
    numbers = [array.dtype.kind in "iuf" for array in (old, new)]
    alike = all(numbers) or old.dtype.kind == new.dtype.kind != "O"
    if not alike or old.shape != new.shape:
        raise ConfigError(place, value, f"must be like {before!r}")
    if all(numbers) and not np.isfinite(new).all():
        raise ConfigError(place, value, "must be finite")
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
        why = f"{did_you_mean(name, WRAPPERS)}, or module.Wrapper from a package"
        raise ConfigError("env.wrappers", name, why)
    place = f"env.wrappers.{name}"
    _, *parameters = _parameters(cls).items()  # the first one is env
    _check_arguments(place, arguments, dict(parameters))
    tuples = {k: tuple(v) if type(v) is list else v for k, v in arguments.items()}
    try:
        return cls(env, **tuples)
    except Exception as error:  # of a wrapper's code
        why = f"the wrapper failed: {type(error).__name__}: {error}"
        raise ConfigError(place, arguments, why) from error
