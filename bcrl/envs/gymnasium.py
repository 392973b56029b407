"""Any Gymnasium environment whose observations are vectors and actions Discrete."""

import functools
import itertools
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, fields
from typing import ClassVar, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bcrl.common.checks import one_of
from bcrl.envs._recipe import Recipe, spec_of
from bcrl.envs.base import RULES, Floats, Ints, Lanes, check_episodes, default_success
from bcrl.envs.checks import check_different, described, once, unresolved
from bcrl.envs.classic import physics_of
from bcrl.envs.compiled_lanes import Alone, CompiledLanes, model_of, sines_differ
from bcrl.envs.simulators import SimulatedLanes, Simulator, vectors
from bcrl.errors import BcrlError, ConfigError, at_least

_TRIES = 5  # random episodes that are played in every task before any work
_STEPS, _SECONDS = 2_000, 5.0  # of each, and their time altogether
_KEPT = 4_000_000  # numbers of their observations, to see how fine they are


class Trial(NamedTuple):
    """What a simulator's spaces and random episodes have shown."""

    n_actions: int
    state_dim: int
    trace: list[tuple]  # per step, a digest of each episode
    fresh: bool  # whether episodes repeat themselves in new simulators only
    notes: list[str]  # about answers that were converted, and components too fine
    success: str  # the rule that `auto` chooses
    compiled: bool  # whether compiled steps gave the same episodes


@dataclass(frozen=True)
class Gymnasium(Recipe):
    """A task of `gymnasium.make(id, **kwargs)`, changed by attributes and wrappers.

    | | |
    |---|---|
    | observation | the space's members, flattened; or the values of `observation`, a trusted function `module.name`, for them |
    | actions | the Discrete space's, counted from 0 |
    | dynamics | the environment's; each reset gets a seed for all randomness |
    | absorbing | terminated; truncated by a wrapper is cut, as at the horizon |
    | horizon | `horizon` steps, else the registered `max_episode_steps` |
    | success | the rule `success`: absorbed, survived, unpunished, rewarded, threshold (`success_threshold`, else the registered one) or info; `auto` chooses by random play |

    Tasks differ in `kwargs` of the constructor, in `attributes` set on the unwrapped
    environment, in `wrappers` ({name: …, arguments}) or in any other field.
    `starts` episodes measure each FQI iteration. `action_vectors` (A, k) are needed by
    residual policies. `verify=False` accepts tasks that behave alike or that differ
    when they are repeated. Raises BcrlError for a wrong field or a broken simulator.
    """  # noqa: E501

    gamma: float = 0.99
    horizon: int | None = None
    success: str = "auto"
    success_threshold: float | None = None
    starts: int = 20
    action_vectors: list[list[float]] | None = None
    verify: bool = True

    name: ClassVar[str] = "gymnasium"
    initial_noise: ClassVar[int] = 1  # the seed of a reset
    step_noise: ClassVar[int] = 0
    trial: ClassVar[Trial]  # Every task gets its own value of these.
    n_actions: ClassVar[int]
    state_dim: ClassVar[int]
    actions: ClassVar[Floats | None]  # `action_vectors` as an array (A, k)

    __hash__ = Recipe.__hash__

    def __post_init__(self) -> None:
        at_least("env.starts", self.starts, 1)
        spec = spec_of(self.id)
        horizon = spec.max_episode_steps if self.horizon is None else self.horizon
        if horizon is None:
            why = f"is needed: {self.id} is registered without a number of steps"
            raise ConfigError("env.horizon", None, why)
        check_episodes(self.gamma, horizon)
        seen = trial(self.recipe, horizon, self.verify)
        rule, threshold = self._success(spec.reward_threshold, seen.success)
        own = self.action_vectors
        sizes = [len(vector) for vector in own or ()]
        if own is not None and (sizes != sizes[:1] * seen.n_actions or not any(sizes)):
            why = f"must be {seen.n_actions} vectors of one length, one per action"
            raise ConfigError("env.action_vectors", own, why)
        derived = {"horizon": horizon, "success": rule, "success_threshold": threshold}
        derived |= {"actions": None if own is None else np.array(own, np.float64)}
        derived |= {"trial": seen, "n_actions": seen.n_actions}
        for key, value in (derived | {"state_dim": seen.state_dim}).items():
            object.__setattr__(self, key, value)

    def _success(self, registered: float | None, suits: str) -> tuple:
        """The rule, `suits` if it is `auto`, and the threshold of `threshold`."""
        rule, threshold = self.success, self.success_threshold
        one_of("env.success", rule, (*RULES, "auto"))
        if rule == "auto":
            rule = suits if threshold is None else "threshold"
        if rule == "threshold" and threshold is None:
            threshold = registered
        if self.success == "auto":
            value = "" if threshold is None else f" (a return of {threshold})"
            once(f"env.id={self.id}: an episode is solved if env.success={rule}{value}")
        if (rule == "threshold") == (threshold is None):
            why = "is a return, needed with env.success=threshold and only then"
            raise ConfigError("env.success_threshold", threshold, why)
        return rule, threshold

    @property
    def recipe(self) -> Recipe:
        """What makes the task's simulators."""
        return Recipe(*(getattr(self, field.name) for field in fields(Recipe)))

    def initial(self, noise: Floats) -> Floats:
        """The numbers that reset lanes: the noise (..., 1) itself."""
        return noise

    def simulator(self, render_mode: str | None = None) -> Simulator:
        """A new simulator of this task."""
        return Simulator(self, self.state_dim, self.trial.fresh, render_mode)

    def lanes(self) -> Lanes:
        """Compiled lanes if the trial allows them, else simulators side by side."""
        return CompiledLanes(self) if self.trial.compiled else SimulatedLanes(self)

    def evaluation_states(self) -> Floats:
        """Observations after `starts` resets, always the same ones, (starts, d)."""
        with closing(self.simulator()) as simulator:
            numbers = (np.arange(self.starts) + 0.5) / self.starts
            return np.array([simulator.reset(each) for each in numbers])

    def pictures(self, start: Floats, actions: Ints) -> Iterator[NDArray[np.uint8]]:
        """The environment's T + 1 pictures of an episode; BcrlError if it has none."""
        with closing(self.simulator("rgb_array")) as simulator:
            try:
                simulator.reset(start[0])
                yield simulator.env.render()
                for action in actions.tolist():
                    simulator.step(action)
                    yield simulator.env.render()
            except Exception as error:  # of foreign code
                why = f"{self.id} draws no picture ({described(error)}); it may need "
                why += "pip install 'boosted-curriculum-rl[rendering]'"
                raise BcrlError(why) from error

    @staticmethod
    def check_tasks(tasks: Sequence["Gymnasium"]) -> None:
        """Raise ConfigError for tasks that are alike; print their notes."""
        for task in tasks:
            for note in task.trial.notes:
                once(f"env.id={task.id}: {note}")
        if tasks[-1].verify:
            traces = [task.trial.trace for task in tasks]
            check_different(tasks, traces, "env.verify=false")


@functools.lru_cache(maxsize=256)
def trial(recipe: Recipe, horizon: int, verify: bool) -> Trial:
    """Play random episodes side by side and, to `verify`, the same ones in turn."""
    first, *_ = simulators = [Simulator(recipe) for _ in range(_TRIES)]
    rng = np.random.default_rng(0)
    trace: list[tuple] = []
    seen: list[Floats] = []
    rewards: list[float] = []
    try:
        n_actions = _n_actions(first)
        actions = rng.integers(n_actions, size=(min(horizon, _STEPS), _TRIES)).T
        played = map(_episode, simulators, itertools.count(), actions.tolist())
        deadline = time.monotonic() + _SECONDS
        for outcomes in itertools.zip_longest(*played):
            running = [outcome for outcome in outcomes if outcome]
            if len(seen) * first.state_dim < _KEPT:
                seen += [state for _, state, *_ in running]
            if trace:  # not the reset
                rewards += [reward for *_, reward, ended in running if not ended]
            trace.append(tuple(outcome and outcome[0] for outcome in outcomes))
            if time.monotonic() > deadline:
                break
        classic = physics_of(first.env.unwrapped) is not None
    finally:
        for simulator in simulators:
            simulator.close()
    notes = []
    if recipe.observation is None and not isinstance(first.space, spaces.Box):
        space = " ".join(str(first.space).split())[:90]
        note = f"observations, {space}, are flattened to "
        notes.append(f"{note}{first.state_dim} numbers, as by FlattenObservation")
    unsteady = _unsteady(Simulator(recipe), actions, trace) if verify else ""
    if unsteady and _unsteady(Simulator(recipe, fresh=True), actions, trace):
        why = f"{unsteady} differs after the same reset and actions; expected the same "
        why += "each time: randomness from reset(seed=…) only, no state that outlives "
        why += "a reset or that simulators share"
        raise ConfigError("env.id", recipe.id, why)
    if unsteady:
        notes.append("a reset leaves something behind, so each episode has a new one")
    model = model_of(recipe) if classic else None
    if model and (differs := _unsteady(Alone(model), actions, trace)):
        notes.append(f"steps are not compiled, since {differs} would differ")
        model = None
    if model and sines_differ():
        note = "NumPy's sines differ from the C library's on this processor, so a step "
        notes.append(f"{note}may differ from Gymnasium's in the last bits")
    if coarse := unresolved(np.array(seen)):
        wrapper = "env.wrappers=[{name: RescaleObservation, min_obs: -1, max_obs: 1}]"
        notes.append(f"{coarse}; rescale: {wrapper} or env.observation=module.function")
    reports = any(simulator.reports for simulator in simulators)
    low, high = min(rewards, default=0.0), max(rewards, default=0.0)
    rule = default_success(reports, low, high, spec_of(recipe.id).reward_threshold)
    found = n_actions, first.state_dim, trace, bool(unsteady), notes, rule
    return Trial(*found, model is not None)


def _episode(
    simulator: Simulator | Alone, number: int, actions: list[int]
) -> Iterator[tuple]:
    """A digest, observation, reward and end after the reset and each step."""
    outcome = simulator.reset((number + 0.5) / _TRIES), 0.0, False, False
    for action in [*actions, None]:
        yield hash((outcome[0].tobytes(), *outcome[1:])), *outcome[:3]
        if action is None or any(outcome[2:]):  # terminated or truncated
            return
        outcome = simulator.step(action)


def _unsteady(simulator: Simulator | Alone, actions: NDArray, trace: list) -> str:
    """The first step that differs when a simulator plays the episodes in turn."""
    with closing(simulator):
        for number, own in enumerate(actions.tolist()):
            played = _episode(simulator, number, own)
            for t, (outcome, expected) in enumerate(zip(played, trace, strict=False)):
                if outcome[0] != expected[number]:
                    return f"{f'step {t}' if t else 'reset'} of episode {number + 1}"
    return ""


def _n_actions(simulator: Simulator) -> int:
    """The number of actions; ConfigError for spaces that can't be learned in."""
    simulator.open()
    recipe, space, actions = simulator.recipe, simulator.space, simulator.actions
    if not isinstance(actions, spaces.Discrete):
        box = "env.wrappers=[{name: DiscretizeAction, bins: 5}]"
        hint = box if isinstance(actions, spaces.Box) else "a wrapper can number them"
        why = f"has actions {actions}, only Discrete ones can be learned; {hint}"
    elif recipe.observation is None and vectors(space) is None:
        why = f"has observations {space}, no gymnasium space of vectors of one length; "
        if isinstance(space, spaces.Dict):
            keys = [str(k) for k, part in space.items() if vectors(part) is not None]
            wrapper = f"{{name: FilterObservation, filter_keys: [{', '.join(keys)}]}}"
            ready = "{name: minigrid.wrappers.ImgObsWrapper}"
            wrapper = ready if recipe.id.startswith("minigrid:") else wrapper
            why += f"env.wrappers=[{wrapper}], or "
        why += "env.observation=module.function makes an array of them"
    else:
        return int(actions.n)
    raise ConfigError("env.id", recipe.id, why)


ENV = Gymnasium
