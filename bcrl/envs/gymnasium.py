"""Any Gymnasium environment whose observations are vectors and actions Discrete."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from numbers import Integral, Real
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bcrl.common import plugins
from bcrl.envs import _simulators as simulators
from bcrl.envs._contract import Simulator, plain_parts
from bcrl.envs._lanes import SimulatedLanes
from bcrl.envs._success import RULES, default
from bcrl.envs._trial import FRESH, TRIES, once, trial
from bcrl.envs.base import check_episodes
from bcrl.errors import BcrlError, ConfigError, at_least, did_you_mean

MOST = 2**15 - 1  # actions, kept as int16
RESCALE = "rescale: env.wrappers=[{name: RescaleObservation, min_obs: -1, max_obs: 1}]"
RESCALE += " where the Box has bounds, else env.observation=module.function"


@dataclass(frozen=True)
class Gymnasium:
    """A task of `gymnasium.make(id, **kwargs)`, changed by attributes and wrappers.

    | | |
    |---|---|
    | observation | the Box, Discrete, Tuple or Dict …, flattened; or what `observation`, a function `module.name` that is trusted, makes of an observation |
    | actions | the Discrete space's, counted from 0 |
    | dynamics | the environment's own; its randomness follows from the seed of each reset |
    | absorbing | terminated; truncated by a wrapper is cut, as at the horizon |
    | horizon | `horizon` steps, else the registered `max_episode_steps` |
    | success | `success` names the rule: absorbed, survived, unpunished, rewarded, threshold (`success_threshold`, else the registered one) or info; `auto` chooses by random play |

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
    success: str = "auto"
    success_threshold: Any = None
    starts: int = 20
    action_vectors: Any = None
    verify: bool = True

    name: ClassVar[str] = "gymnasium"
    # n_actions, state_dim and first_action (what the simulator calls action 0) are
    # set from a simulator's spaces and its first observation.
    initial_noise: ClassVar[int] = 1  # the seed of a reset
    step_noise: ClassVar[int] = 0

    def __post_init__(self) -> None:
        at_least("env.starts", self.starts, 1)
        for key, kind in (("kwargs", dict), ("attributes", dict), ("wrappers", list)):
            value = getattr(self, key)
            if not isinstance(value, (kind, type(None))):
                noun = "names and values" if kind is dict else "a list of sections"
                raise ConfigError(f"env.{key}", value, f"must be {noun}, or null")
        spec = simulators.spec_of(self.id)
        horizon = self.horizon
        if horizon is None and (horizon := spec.max_episode_steps) is None:
            why = f"is needed: {self.id} has no limit of its own (a number of steps)"
            raise ConfigError("env.horizon", None, why)
        if not isinstance(horizon, Integral) or isinstance(horizon, bool):
            raise ConfigError("env.horizon", horizon, "must be an integer, or null")
        object.__setattr__(self, "horizon", horizon := int(horizon))
        check_episodes(self.gamma, horizon)
        self._resolve_success(spec.reward_threshold)
        for name, value in _facts(_measured(self)).items():
            object.__setattr__(self, name, value)
        if self.action_vectors is not None:
            self._check_vectors()

    def _resolve_success(self, registered: float | None) -> None:
        """Name the rule of `auto`, and the threshold of the rule that needs one."""
        rule, threshold = self.success, self.success_threshold
        if rule not in (*RULES, "auto"):
            why = did_you_mean(str(rule), (*RULES, "auto"))
            raise ConfigError("env.success", rule, why)
        if threshold is not None:
            number = isinstance(threshold, Real) and not isinstance(threshold, bool)
            if not number or not np.isfinite(threshold):
                why = "must be a number, the return that counts as solved, or null"
                raise ConfigError("env.success_threshold", threshold, why)
            if rule not in ("auto", "threshold"):
                why = f"has no effect with env.success={rule}; env.success=threshold"
                raise ConfigError("env.success_threshold", threshold, why)
            rule = "threshold"
        elif rule == "threshold":
            if (threshold := registered) is None:
                why = f"is needed: {self.id} is registered without one (a return)"
                raise ConfigError("env.success_threshold", None, why)
        elif rule == "auto":
            seen = trial(_measured(self))
            found = default(seen.reports, seen.low, seen.high, registered)
            rule, threshold = found
            once(f"env.id={self.id}: solved is env.success={found}")
        threshold = None if rule != "threshold" else float(threshold)
        object.__setattr__(self, "success", rule)
        object.__setattr__(self, "success_threshold", threshold)

    def _check_vectors(self) -> None:
        try:
            vectors = np.array(self.action_vectors, float)
            fits = vectors.ndim == 2 and len(vectors) == self.n_actions
            fits = fits and vectors.size > 0 and np.isfinite(vectors).all()
        except (TypeError, ValueError):
            fits = False
        if not fits:
            why = f"must be {self.n_actions} vectors of one length, one per action"
            raise ConfigError("env.action_vectors", self.action_vectors, why)

    def __hash__(self) -> int:
        return hash((self.id, self.horizon, self.gamma))  # dicts have none

    def __reduce__(self) -> tuple:
        return _made, (_fields(self), self.fresh)  # what is cached stays here

    @property
    def fresh(self) -> bool:
        """Whether every episode needs a new simulator, as random play has shown."""
        return _measured(self) in FRESH

    @property
    def actions(self) -> NDArray[np.float64] | None:
        """`action_vectors` as an array (A, k)."""
        vectors = self.action_vectors
        return None if vectors is None else np.array(vectors, np.float64)

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
        lanes = SimulatedLanes(self, render_mode="rgb_array")
        try:
            lanes.begin(start[None])
            yield self._picture(lanes)
            for action in actions:
                lanes.step(None, action[None], None)
                yield self._picture(lanes)
        finally:
            lanes.close()

    def _picture(self, lanes: SimulatedLanes) -> NDArray[np.uint8]:
        for why in lanes.failures.values():
            raise BcrlError(why)
        try:
            return lanes.running[0].env.render()
        except Exception as error:  # of foreign code
            text = "pip install 'boosted-curriculum-rl[rendering]' may be what it needs"
            why = f"{type(error).__name__} {error}".strip()
            raise BcrlError(f"{self.id} draws nothing ({why}); {text}") from error

    @functools.cached_property
    def map(self) -> Any:
        """The function `observation`."""
        name = str(self.observation)
        return plugins.attribute("env.observation", name, name)

    def initial(self, noise: NDArray[np.float64]) -> NDArray[np.float64]:
        """What lanes are reset by: the noise (…, 1) itself."""
        return noise

    def lanes(self) -> SimulatedLanes:
        """Simulators side by side."""
        return SimulatedLanes(self)

    def evaluation_states(self) -> NDArray[np.float64]:
        """Observations after `starts` resets, always the same ones, (starts, d)."""
        numbers = (np.arange(self.starts) + 0.5) / self.starts
        lanes, found = SimulatedLanes(self), []  # one simulator is enough
        try:
            for number in numbers:
                found.append(lanes.begin(np.full((1, 1), number))[0])
                for why in lanes.failures.values():
                    raise BcrlError(why)
        finally:
            lanes.close()
        return np.array(found)

    @staticmethod
    def check_tasks(tasks: Sequence[Gymnasium]) -> None:
        """Raise BcrlError for tasks that are alike, or that break the contract.

        Notes say what is adapted, and what float32 does not resolve.
        """
        trials = [trial(_measured(task)) for task in tasks]
        for task, seen in zip(tasks, trials, strict=True):
            if seen.unsteady:
                why = f"{seen.unsteady} is another after the same reset and actions; "
                why += "expected the same each time: randomness from reset(seed=…) "
                why += "only, no state that outlives a reset or that simulators share"
                raise ConfigError("env.id", task.id, why)
            if seen.adapted:
                once(f"env.id={task.id}: {'; '.join(seen.adapted)}")
            if seen.coarse:
                more = len(seen.coarse) - 1
                text = f"{seen.coarse[0]}{f' ({more} more like it)' * (more > 0)}"
                once(f"env.id={task.id}: {text}; {RESCALE}")
        for number, (task, after) in enumerate(pairwise(tasks), start=1):
            one, other = trials[number - 1 : number + 1]
            same = (task.horizon, task.gamma) == (after.horizon, after.gamma)
            if tasks[-1].verify and same and not one.differs(other):
                why = f"tasks {number} and {number + 1} behave alike in {TRIES} "
                why += "episodes of random play, so what differs may not be applied "
                why += "(env.verify=false if that is as it should be)"
                raise ConfigError("env.tasks", _difference(task, after), why)


def _difference(one: Gymnasium, other: Gymnasium) -> str:
    if one == other:
        return "the same twice"
    a, b = _fields(one), _fields(other)
    return ", ".join(f"{key}: {a[key]} → {b[key]}" for key in a if a[key] != b[key])


def _fields(task: Gymnasium) -> dict[str, Any]:
    """All that a task is made from."""
    return {f.name: getattr(task, f.name) for f in fields(task)}


def _measured(task: Gymnasium) -> Gymnasium:
    """The task without what does not show in its episodes."""
    plain = {"success": "absorbed", "success_threshold": None, "action_vectors": None}
    plain |= {"gamma": 0.0, "starts": 1}
    if all(getattr(task, key) == value for key, value in plain.items()):
        return task
    return replace(task, **plain)


@functools.lru_cache(maxsize=256)
def _facts(task: Gymnasium) -> dict[str, int]:
    """What a simulator's spaces and first observation say of a task."""
    simulator = Simulator(task)
    try:
        space, actions = simulator.space, simulator.actions
        if not isinstance(actions, spaces.Discrete):
            why = f"has actions {actions}, only Discrete ones can be learned; "
            why += (
                "env.wrappers=[{name: DiscretizeAction, bins: 5}]"
                * isinstance(actions, spaces.Box)
                or "a wrapper of your own can number them"
            )
            raise ConfigError("env.id", task.id, why)
        if not 1 <= actions.n <= MOST:
            why = f"has {actions.n} actions, from 1 to {MOST} can be learned"
            raise ConfigError("env.id", task.id, why)
        if not isinstance(space, spaces.Space):
            came = f"{space!r} of type {type(space).__module__}.{type(space).__name__}"
            raise simulator.broken("observation_space", came, "a space of gymnasium's")
        if task.observation is None and not plain_parts(space):
            raise ConfigError("env.id", task.id, _no_vector(task, space))
        seen = simulator.reset(seed=0)
    finally:
        simulator.close()
    facts = {"n_actions": int(actions.n), "first_action": int(actions.start)}
    return facts | {"state_dim": len(seen)}


def _no_vector(task: Gymnasium, space: spaces.Space) -> str:
    """Why observations can't be learned from, and what makes a vector of them."""
    why = f"has observations {space}, which are no vector of a fixed length; "
    if task.id.startswith("minigrid:"):
        why += "env.wrappers=[{name: minigrid.wrappers.ImgObsWrapper}], or "
    if isinstance(space, spaces.Dict):
        keys = [key for key, part in space.spaces.items() if plain_parts(part)]
        if keys:
            listed = f"filter_keys: [{', '.join(map(str, keys))}]"
            why += f"env.wrappers=[{{name: FilterObservation, {listed}}}], or "
    return f"{why}env.observation=module.function makes an array of them"


def _made(fields: dict[str, Any], fresh: bool) -> Gymnasium:
    task = Gymnasium(**fields)
    if fresh:
        FRESH.add(_measured(task))
    return task


ENV = Gymnasium
