"""Gymnasium environments as lanes: made from plain values, stepped, and replayed."""

from __future__ import annotations

import copy
import inspect
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec, load_env_creator
from numpy.typing import NDArray

from bcrl import trust
from bcrl.errors import BcrlError, ConfigError, did_you_mean
from bcrl.pack import DERIVED, storable

if TYPE_CHECKING:
    from bcrl.envs.gymnasium import Gymnasium

#: Gymnasium's wrappers that keep nothing beyond an episode and write nothing.
WRAPPERS = (
    *("ClipReward", "DelayObservation", "FlattenObservation", "FrameStackObservation"),
    *("MaxAndSkipObservation", "RescaleObservation", "StickyAction"),
)
#: Arguments of `gymnasium.make` itself, and what opens windows.
OURS = ("max_episode_steps", "disable_env_checker", "render_mode")


def spec_of(name: str) -> EnvSpec:
    """The registered environment `name`; ConfigError if there is none.

    `module:Name-v0` imports the module first, if BCRL_TRUST allows it.
    """
    module, colon, name_there = name.rpartition(":")
    if colon:
        trust.module("env.id", name, module)
    if name_there not in gymnasium.registry:
        known = [
            n for n in gymnasium.registry if not n.startswith(("phys2d", "tabular"))
        ]
        raise ConfigError("env.id", name, did_you_mean(name_there, known))
    return gymnasium.registry[name_there]


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
    _check_arguments("env.kwargs", kwargs, _creator(spec))
    with warnings.catch_warnings():  # of precision and of old versions, each time
        warnings.simplefilter("ignore", UserWarning)
        limits = {"max_episode_steps": -1, "disable_env_checker": True}
        drawn = {"render_mode": render_mode} if render_mode else {}
        env = gymnasium.make(spec, **drawn, **limits, **kwargs)
        for key, value in attributes.items():
            _set(env, key, value)
        for wrapper in wrappers:
            env = _wrapped(env, wrapper)
    return env


def _creator(spec: EnvSpec) -> Any:
    point = spec.entry_point
    return load_env_creator(point) if isinstance(point, str) else point


def _check_arguments(key: str, arguments: Mapping, made: Any, first: int = 0) -> None:
    """Raise ConfigError for a keyword that `made` doesn't take, or that is ours."""
    parameters = list(inspect.signature(made).parameters.values())[first:]
    known = [p.name for p in parameters if p.name not in OURS]
    anything = any(p.kind is p.VAR_KEYWORD for p in parameters)
    for argument, value in arguments.items():
        if argument in OURS:
            raise ConfigError(f"{key}.{argument}", value, "is set by bcrl")
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
    name = wrapper["name"]
    if "." in name:
        cls = trust.attribute("env.wrappers", name, name)
    elif name in WRAPPERS:
        cls = getattr(gymnasium.wrappers, name)
    else:
        why = f"{did_you_mean(name, WRAPPERS)}, or module.Wrapper of your own"
        raise ConfigError("env.wrappers", name, why)
    _check_arguments(f"env.wrappers.{name}", arguments, cls.__init__, 2)
    try:
        return cls(env, **arguments)
    except Exception as error:  # whatever a wrapper does
        why = f"can't wrap it: {type(error).__name__}: {error}"
        raise ConfigError(f"env.wrappers.{name}", arguments, why) from error


@storable
@dataclass(eq=False)
class SimulatedLanes:
    """Simulators that are stepped side by side; `lanes` index their leading axes.

    An episode follows from what its lane was reset by and the actions since, so that is
    all that is stored; what comes out of a checkpoint plays them once more.
    """

    env: Gymnasium
    start: NDArray[np.float64] | None = None  # (…, 1) in [0, 1)
    taken: NDArray[np.int16] | None = None  # (…, horizon) actions
    length: NDArray[np.intp] | None = None  # (…) how many of them
    running: list[gymnasium.Env] = field(default_factory=list, metadata=DERIVED)
    render_mode: str | None = None
    failures: dict[int, str] = field(default_factory=dict, metadata=DERIVED)

    def begin(self, start: NDArray[np.float64]) -> NDArray[np.float64]:
        """Reset every lane; the observations (…, d)."""
        shape = start.shape[:-1]
        self.start = start.copy()
        self.length = np.zeros(shape, np.intp)
        self.taken = np.zeros((*shape, self.env.horizon), np.int16)
        self._make()
        state = np.empty((*shape, self.env.state_dim))
        return self.restart(np.ones(shape, bool), start, state)

    def step(
        self,
        state: NDArray[np.float64] | None,
        action: NDArray[np.integer],
        noise: NDArray[np.float64] | None,
        lanes: Any = ...,
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """A step of the chosen lanes: observations, rewards, terminated, truncated."""
        self._wake()
        chosen = self._numbers[lanes].reshape(-1)
        acts, length = action.reshape(-1), self.length.reshape(-1)
        self.taken.reshape(len(length), -1)[chosen, length[chosen]] = acts
        length[chosen] += 1
        after = np.empty((len(chosen), self.env.state_dim))
        reward, ended = np.empty(len(chosen)), np.empty((2, len(chosen)), bool)
        for i, (lane, act) in enumerate(zip(chosen, acts.tolist(), strict=True)):
            seen, reward[i], *ended[:, i], _ = self._act(lane, act)
            after[i] = self.env.observed(seen)
        self._check(after, reward)
        shape = action.shape
        return (
            after.reshape(*shape, -1),
            reward.reshape(shape),
            *ended.reshape(2, *shape),
        )

    def restart(
        self,
        over: NDArray[np.bool_],
        start: NDArray[np.float64],
        state: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """All observations, those of lanes that are over after a reset."""
        self._wake()
        state = state.copy()
        self.start[over], self.length[over] = start[over], 0
        fresh = [self._reset(lane) for lane in self._numbers[over]]
        state[over] = np.reshape(fresh, (-1, self.env.state_dim))
        self._check(state)
        return state

    @property
    def _numbers(self) -> NDArray[np.intp]:
        return np.arange(self.length.size).reshape(self.length.shape)

    def _reset(self, lane: int) -> NDArray[np.float64]:
        seed = int(self.start.reshape(-1)[lane] * 2**53)
        try:
            return self.env.observed(self.running[lane].reset(seed=seed)[0])
        except Exception as error:
            text = f"a reset failed: {type(error).__name__}: {error}"
            raise BcrlError(f"env.id={self.env.id}: {text}") from error

    def _act(self, lane: int, action: int) -> tuple:
        try:
            return self.running[lane].step(action + self.env.first_action)
        except Exception as error:  # whatever a foreign environment does
            text = f"a step failed: {type(error).__name__}: {error}"
            raise BcrlError(f"env.id={self.env.id}: {text}") from error

    def _make(self) -> None:
        for simulator in self.running:
            simulator.close()
        count, mode = self.length.size, self.render_mode
        self.running = [self.env.simulator(mode) for _ in range(count)]

    def _wake(self) -> None:
        """Bring lanes that come out of a checkpoint to where they were."""
        if self.running or not self.length.size:
            return
        self._make()
        taken = self.taken.reshape(self.length.size, -1)
        for lane, length in enumerate(self.length.reshape(-1)):
            self._reset(lane)
            for action in taken[lane, :length].tolist():
                self._act(lane, action)

    def _check(self, *found: NDArray) -> None:
        if not all(np.isfinite(values).all() for values in found):
            text = "gave an observation or reward that is not finite"
            raise BcrlError(f"env.id={self.env.id}: {text}")
