"""Lanes of Gymnasium's classic control, all stepped in one compiled call.

A simulator makes the start of each episode, with all of its randomness. From there on,
`classic.py` has the physics.
"""

import functools
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bcrl.common.serialization import storable
from bcrl.envs._recipe import Recipe
from bcrl.envs.base import Bools, Floats, Ints, Lanes
from bcrl.envs.checks import LARGEST
from bcrl.envs.classic import Physics, UnknownPhysics, physics_of
from bcrl.envs.simulators import SEEDS

#: Gymnasium's wrappers that are functions of an action, or of an observation number by
#: number, so that one call transforms the observations of all lanes.
_OF_ACTIONS = ("ClipAction", "DiscretizeAction", "RescaleAction")
_OF_OBSERVATIONS = ("RescaleObservation",)


@dataclass(eq=False)
class Model:
    """Gymnasium's own resets and the compiled steps that continue from them."""

    env: Any  # an environment that resets
    physics: Physics
    constants: tuple
    rescaling: list[Any]  # wrappers of observations, the innermost first

    def reset(self, numbers: Floats) -> tuple[Floats, Floats]:
        """Hidden states (n, h) and observations (n, d) after resets by `numbers`."""
        hidden, seen, inner = [], [], self.env.unwrapped
        for seed in (numbers * SEEDS).astype(np.int64).tolist():
            seen.append(self.env.reset(seed=seed)[0])
            hidden.append(inner.state)
        return np.array(hidden, np.float64), np.array(seen, np.float64)

    def step(self, hidden: Floats, action: Ints) -> tuple[Floats, Floats, Any, Any]:
        """Hidden states (..., h), observations (..., d), rewards and terminated."""
        after, reward, ended = self.physics.step(hidden, action, None, *self.constants)
        with np.errstate(over="ignore", invalid="ignore"):  # the lanes check for it
            seen = self.physics.observation(after.reshape(-1, after.shape[-1]))
            for wrapper in self.rescaling:
                seen = wrapper.observation(seen)
        return after, seen.reshape(*reward.shape, -1).astype(np.float64), reward, ended


@functools.lru_cache(maxsize=256)
def model_of(recipe: Recipe) -> Model | None:
    """The model of a recipe's environment; None if its steps are not compiled."""
    if recipe.observation is not None:
        return None
    env: Any = recipe.make()
    whole, start = env, int(env.action_space.start)
    actions: list = [start + i for i in range(int(env.action_space.n))]
    rescaling: list[Any] = []
    try:
        while env is not env.unwrapped:
            owner, name = type(env).__module__, type(env).__name__
            if not owner.startswith("gymnasium.wrappers."):
                return None
            if name in _OF_ACTIONS:
                actions = [env.action(action) for action in actions]
            elif name in _OF_OBSERVATIONS:
                rescaling.insert(0, env)
            elif name != "OrderEnforcing":
                return None
            env = env.env
        if (physics := physics_of(env)) is None:
            return None
        constants = physics.constants(env, actions)
    except (UnknownPhysics, ArithmeticError):
        return None
    return Model(whole, physics, constants, rescaling)


class Alone:
    """One lane of a model, with a Simulator's methods."""

    def __init__(self, model: Model) -> None:
        self.model = model

    def reset(self, number: float) -> Floats:
        """The first observation (d,)."""
        self.hidden, seen = self.model.reset(np.array([number]))
        return seen[0]

    def step(self, action: int) -> tuple[Floats, float, bool, bool]:
        """Observation (d,), reward, terminated, truncated."""
        self.hidden, *found = self.model.step(self.hidden, np.array([action]))
        seen, reward, ended = (each[0] for each in found)
        return seen, float(reward), bool(ended), False

    def close(self) -> None:
        """Keep the model open, for others use it, too."""


@functools.cache
def sines_differ() -> bool:
    """Whether NumPy's sine or cosine differs from that of compiled code."""
    x = np.linspace(-7.0, 7.0, 5001)
    pairs = (np.sin, math.sin), (np.cos, math.cos)  # compiled code calls the latter
    return any(a(x).tolist() != list(map(b, x.tolist())) for a, b in pairs)


@storable
@dataclass(eq=False)
class CompiledLanes(Lanes):
    """The lanes of a task that has a model."""

    hidden: Floats = field(default_factory=lambda: np.empty((0, 0)))  # (..., h)

    @functools.cached_property
    def _model(self) -> Any:
        return model_of(self.env.recipe)

    def begin(self, start: Floats) -> Floats:
        """First observations (..., d) after resets by numbers (..., 1) in [0, 1)."""
        self.failures, lead = {}, start.shape[:-1]
        self.hidden, seen = self._model.reset(start.reshape(-1))
        self.hidden = self.hidden.reshape(*lead, -1)
        return seen.reshape(*lead, -1)

    def step(self, state: Any, action: NDArray, noise: Any, lanes: Any = ...) -> tuple:
        """Observations, rewards, terminated and truncated of the chosen lanes."""
        found = self._model.step(self.hidden[lanes], action)
        self.hidden[lanes], seen, reward, ended = found
        if self.failures or not np.abs(seen).max(initial=0.0) <= LARGEST:
            failed = self._failed(seen, lanes)
            seen[failed], reward[failed], ended[failed] = 0.0, 0.0, False
            return seen, reward, ended, failed
        return seen, reward, ended, False

    def restart(self, over: Bools, start: Floats, state: Floats) -> Floats:
        """All observations; lanes that are over are reset."""
        state, over = state.copy(), over.copy()
        over.reshape(-1)[list(self.failures)] = False
        if over.any():
            found = self._model.reset(start[over][:, 0])
            self.hidden[over], state[over] = found
        return state

    @property
    def succeeded(self) -> Bools:
        """Whether info reported success: it never does."""
        return np.zeros(self.hidden.shape[:-1], bool)

    def _failed(self, seen: Floats, lanes: Any) -> Bools:
        """The chosen lanes that have failed by now."""
        lead = self.hidden.shape[:-1]
        numbers = np.arange(math.prod(lead)).reshape(lead)[lanes]
        wrong = ~(np.abs(seen) <= LARGEST).all(-1)
        why = f"env.id={self.env.id}: step gave an observation that is not finite; "
        why += f"expected finite numbers of at most {LARGEST:.3g} (float32)"
        self.failures = dict.fromkeys(numbers[wrong].tolist(), why) | self.failures
        return np.isin(numbers, list(self.failures))
