"""Any Gymnasium environment with Box observations and Discrete actions."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bcrl import trust
from bcrl.envs import _simulators as simulators
from bcrl.envs.base import check_episodes
from bcrl.errors import BcrlError, ConfigError, at_least, did_you_mean

SUCCESS = ("absorbed", "survived", "unpunished")
TRIES = 5  # episodes in which two tasks have to differ


@dataclass(frozen=True)
class Gymnasium:
    """A task of `gymnasium.make(id, **kwargs)`, changed by attributes and wrappers.

    | | |
    |---|---|
    | observation | the Box, flattened; or what `observation`, a function `module.name` that is trusted, makes of an observation |
    | actions | the Discrete space's, counted from 0 |
    | dynamics | the environment's own; its randomness follows from the seed of each reset |
    | absorbing | terminated; truncated by a wrapper is cut, as at the horizon |
    | horizon | `horizon` steps, else the registered `max_episode_steps` |
    | success | `absorbed`: the episode ended by itself; `survived`: it lasted to the horizon; `unpunished`: it ended with a reward of 0 or more |

    Tasks differ in `kwargs` of the constructor, in `attributes` set on the unwrapped
    environment, in `wrappers` ({name: …, arguments}) or in any other field.
    `starts` episodes measure each FQI iteration. `action_vectors` (A, k) say what each
    action does, which residual policies want to know. `verify=False` allows tasks that
    random play can't tell apart. Raises ConfigError for whatever of it can't be.
    """  # noqa: E501

    id: str
    kwargs: Any = None
    attributes: Any = None
    wrappers: Any = None
    observation: Any = None
    gamma: float = 0.99
    horizon: Any = None
    success: str = "absorbed"
    starts: int = 20
    action_vectors: Any = None
    verify: bool = True

    name: ClassVar[str] = "gymnasium"
    initial_noise: ClassVar[int] = 1  # the seed of a reset
    step_noise: ClassVar[int] = 0

    def __post_init__(self) -> None:
        if self.success not in SUCCESS:
            why = did_you_mean(str(self.success), SUCCESS)
            raise ConfigError("env.success", self.success, why)
        at_least("env.starts", self.starts, 1)
        for key, kind in (("kwargs", dict), ("attributes", dict), ("wrappers", list)):
            value = getattr(self, key)
            if not isinstance(value, (kind, type(None))):
                noun = "names and values" if kind is dict else "a list of sections"
                raise ConfigError(f"env.{key}", value, f"must be {noun}, or null")
        horizon = self.horizon
        if horizon is None and (horizon := simulators.max_steps(self.id)) is None:
            why = f"is needed: {self.id} has no limit of its own (a number of steps)"
            raise ConfigError("env.horizon", None, why)
        if type(horizon) is not int:
            raise ConfigError("env.horizon", horizon, "must be an integer, or null")
        object.__setattr__(self, "horizon", horizon)
        check_episodes(self.gamma, horizon)
        space = self._simulator.action_space
        if not isinstance(space, spaces.Discrete):
            why = f"has actions {space}, only Discrete ones can be learned"
            raise ConfigError("env.id", self.id, why)
        seen = self._simulator.observation_space
        if self.observation is None and not isinstance(seen, spaces.Box):
            why = f"has observations {seen}, only a Box can be learned from; "
            why += "env.observation=module.function makes an array of them"
            raise ConfigError("env.id", self.id, why)
        if self.observation is not None:
            self._check_map()
        if self.action_vectors is not None:
            self._check_vectors()

    def _check_map(self) -> None:
        try:
            fits = self.state_dim > 0
        except BcrlError:
            raise
        except Exception as error:  # whatever it does
            why = f"{type(error).__name__}: {error}"
            raise ConfigError("env.observation", self.observation, why) from error
        if not fits:
            raise ConfigError("env.observation", self.observation, "gives nothing")

    def _check_vectors(self) -> None:
        try:
            fits = np.array(self.action_vectors, float).shape[:1] == (self.n_actions,)
        except (TypeError, ValueError):
            fits = False
        if not fits:
            why = f"must be {self.n_actions} vectors of one length, one an action"
            raise ConfigError("env.action_vectors", self.action_vectors, why)

    def __hash__(self) -> int:
        return hash((self.id, self.horizon, self.gamma))  # dicts have none

    def __reduce__(self) -> tuple:
        return _made, (_fields(self),)  # what is cached stays here

    @property
    def actions(self) -> NDArray[np.float64] | None:
        """`action_vectors` as an array (A, k)."""
        vectors = self.action_vectors
        return None if vectors is None else np.array(vectors, np.float64)

    @functools.cached_property
    def n_actions(self) -> int:
        """Actions, 0 … n − 1."""
        return int(self._simulator.action_space.n)

    @functools.cached_property
    def first_action(self) -> int:
        """What the simulator calls action 0."""
        return int(self._simulator.action_space.start)

    @functools.cached_property
    def state_dim(self) -> int:
        """Entries of an observation."""
        return len(self.observed(self._simulator.reset(seed=0)[0]))

    @property
    def _simulator(self) -> gymnasium.Env:
        return _first(self)

    def simulator(self, render_mode: str | None = None) -> gymnasium.Env:
        """A new environment of this task, without a time limit."""
        parts = self.kwargs or {}, self.attributes or {}, self.wrappers or []
        return simulators.made(self.id, *parts, render_mode)

    def pictures(
        self, start: NDArray[np.float64], actions: NDArray[np.integer]
    ) -> Iterator[NDArray[np.uint8]]:
        """The environment's own pictures of an episode, one more than actions.

        BcrlError if it draws none.
        """
        lanes = simulators.SimulatedLanes(self, render_mode="rgb_array")
        try:
            lanes.begin(start[None])
            yield lanes.running[0].render()
            for action in actions:
                lanes.step(None, action[None], None)
                yield lanes.running[0].render()
        except (gymnasium.error.Error, NotImplementedError, TypeError) as error:
            text = "pip install 'boosted-curriculum-rl[rendering]' may be what it needs"
            why = f"{type(error).__name__} {error}".strip()
            raise BcrlError(f"{self.id} draws nothing ({why}); {text}") from error

    def observed(self, observation: Any) -> NDArray[np.float64]:
        """An observation as a vector (d,)."""
        if self.observation is not None:
            observation = self._map(observation)
        return np.asarray(observation, np.float64).reshape(-1)

    @functools.cached_property
    def _map(self) -> Any:
        name = str(self.observation)
        return trust.attribute("env.observation", name, name)

    def initial(self, noise: NDArray[np.float64]) -> NDArray[np.float64]:
        """What lanes are reset by: the noise (…, 1) itself."""
        return noise

    def lanes(self) -> simulators.SimulatedLanes:
        """Simulators side by side."""
        return simulators.SimulatedLanes(self)

    def evaluation_states(self) -> NDArray[np.float64]:
        """Observations after `starts` resets, always the same ones, (starts, d)."""
        numbers = (np.arange(self.starts) + 0.5) / self.starts
        return self.lanes().begin(numbers[:, None])

    @staticmethod
    def check_tasks(tasks: Sequence[Gymnasium]) -> None:
        """Raise ConfigError for tasks that are alike, or don't repeat themselves."""
        target = tasks[-1]
        for number, task in enumerate(tasks[:-1], start=1):
            after = tasks[number]
            if target.verify and not differ(task, after):
                why = f"tasks {number} and {number + 1} behave alike in {TRIES} "
                why += "episodes of random play, so what differs may not be applied "
                why += "(env.verify=false if that is as it should be)"
                raise ConfigError("env.tasks", _difference(task, after), why)
        for number, task in enumerate(tasks, start=1):
            if task.verify and not repeats(task):
                why = f"task {number} is another after the same reset and actions; "
                why += "its randomness must come from reset(seed=…)"
                raise ConfigError("env.id", task.id, why)


@functools.lru_cache(maxsize=256)
def repeats(task: Gymnasium) -> bool:
    """Whether the first steps of an episode are the same a second time."""
    return not _play_apart(task, task, min(50, task.horizon))


@functools.lru_cache(maxsize=256)
def differ(one: Gymnasium, other: Gymnasium) -> bool:
    """Whether two tasks lead anywhere else under the same resets and actions."""
    if one == other:
        return False
    if one.horizon != other.horizon or one.gamma != other.gamma:
        return True
    return _play_apart(one, other, one.horizon)


def _play_apart(one: Gymnasium, other: Gymnasium, steps: int) -> bool:
    """Whether anything differs in so many steps of random play."""
    start = (np.arange(TRIES)[:, None] + 0.5) / TRIES
    actions = np.random.default_rng(0).integers(one.n_actions, size=(steps, TRIES))
    pair = [task.lanes() for task in (one, other)]
    begun = [lanes.begin(start) for lanes in pair]
    if not np.array_equal(*begun):
        return True
    alive = np.ones(TRIES, bool)
    for action in actions:
        a, b = (x.step(None, action[alive], None, alive) for x in pair)
        if not all(map(np.array_equal, a, b)):
            return True
        alive[alive] = ~(a[2] | a[3])
        if not alive.any():
            break
    return False


def _difference(one: Gymnasium, other: Gymnasium) -> str:
    if one == other:
        return "the same twice"
    a, b = _fields(one), _fields(other)
    return ", ".join(f"{key}: {a[key]} → {b[key]}" for key in a if a[key] != b[key])


def _fields(task: Gymnasium) -> dict[str, Any]:
    """All that a task is made from."""
    return {f.name: getattr(task, f.name) for f in fields(task)}


@functools.lru_cache(maxsize=64)
def _first(task: Gymnasium) -> gymnasium.Env:
    """One simulator a task, to be asked for its spaces."""
    try:
        return task.simulator()
    except BcrlError:
        raise
    except Exception as error:  # whatever a foreign constructor does
        why = f"can't be made: {type(error).__name__}: {error}"
        raise ConfigError("env.id", task.id, why) from error


def _made(fields: dict[str, Any]) -> Gymnasium:
    return Gymnasium(**fields)


ENV = Gymnasium
