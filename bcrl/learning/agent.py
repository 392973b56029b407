"""What one seed has learned, as an agent that values and chooses actions."""

import math
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space, iterate
from numpy.typing import NDArray

from bcrl.envs import Env, is_simulated
from bcrl.envs.gym_api import GymEnv
from bcrl.errors import BcrlError
from bcrl.learning import Floats, Integers
from bcrl.learning.learned import Learned
from bcrl.learning.policies import combined_actions, greedy
from bcrl.learning.transfer import Acting
from bcrl.q.functions import ZERO, Q


@dataclass(frozen=True, eq=False, repr=False)
class Agent:
    """An agent that was loaded: its Q-functions, its task and its run's config."""

    task: Env  # the target that it has learned
    config: dict[str, Any]  # of its run
    seed: int
    learned: Learned

    def __repr__(self) -> str:
        return f"Agent({self.task.name}, seed {self.seed})"

    @property
    def residuals(self) -> tuple["Residual", ...]:
        """ϱ of the stages that were kept; all stages with boosting or keep=stages."""
        return tuple(Residual(self, own) for own in self.learned.residuals)

    def q(self, observations: Any) -> Floats:
        """The values (n, A) of all actions at n observations of the task, or at one."""
        return self.values(self.learned.result.q, observations)

    def values(self, q: Q, observations: Any) -> Floats:
        """The values (n, A) of a Q-function of one seed at n observations."""
        return self._values(q, self.states(observations)[None])[0]

    def _values(self, q: Q, states: Floats) -> Floats:
        """Values (1, n, A) at states (1, n, d)."""
        stacked: Any = states  # of one seed
        return np.asarray(q(stacked, self.task.n_actions))

    def act(self, observation: Any, rng: np.random.Generator | None = None) -> Any:
        """The greedy action, as Gymnasium counts it; an array (n,) at n observations.

        Of equally good actions it takes the first, or with `rng` any one.
        """
        alone = self._is_one(observation)
        states = self.states(observation)
        u = np.zeros((len(states), 3)) if rng is None else rng.random((len(states), 3))
        chosen = self.choose(states[None], u[None])[0] + self._first_action
        return int(chosen[0]) if alone else chosen

    def choose(self, states: Floats, u: Floats, alive: Any = None) -> Integers:
        """A `Policy`: greedy actions (1, n) at states (1, n, d) by uniforms u."""
        acting = self.learned.result.acting
        if acting is None:
            acting = Acting(self.learned.result.q, np.zeros(1, bool))
        own = greedy(self._values(acting.own, states), u[..., 1])
        if acting.prior is ZERO:
            return own
        advised = greedy(self._values(acting.prior, states), u[..., 2])
        own = np.where(acting.copying[:, None], advised, own)
        return combined_actions(self.task.actions)[advised, own]

    def make(self, render_mode: str | None = None) -> gymnasium.Env:
        """A new Gymnasium environment of the task, cut after its horizon."""
        task: Any = self.task
        simulated = is_simulated(task)
        make = task.recipe.make if simulated else partial(GymEnv, task)
        return gymnasium.wrappers.TimeLimit(make(render_mode), task.horizon)

    def states(self, observations: Any) -> Floats:
        """Observations of the task's Gymnasium environment, or one, as vectors (n, d).

        A vector environment's are taken, too. Raises BcrlError for others.
        """
        if self._is_one(observations):
            observations = [observations]
        d, simulator = self.task.state_dim, self._simulator
        try:
            if simulator is None or isinstance(simulator.members, spaces.Box):
                found = np.asarray(observations, np.float64)
            else:
                each = self._separate(simulator.space, observations)
                found = np.array([simulator.vector("observation", o) for o in each])
                found = found.reshape(-1, d)
        except (LookupError, TypeError, ValueError) as error:
            why = f"these are no observations of {self.task.name}: {error}"
            raise BcrlError(why) from error
        if not found.ndim or (len(found) and math.prod(found.shape[1:]) != d):
            what = f"observations of the shape {found.shape}"
            raise BcrlError(f"{what}; {self.task.name} has {d} numbers: pass (n, {d})")
        return found.reshape(-1, d)

    def _separate(self, space: spaces.Space, observations: Any) -> Iterable[Any]:
        """Each of several observations, also of those that are joined part by part."""
        joined = isinstance(observations, (dict, tuple))
        if joined and not all(map(self._is_one, observations)):
            return iterate(batch_space(space), observations)
        return observations

    @cached_property
    def _simulator(self) -> Any:
        """An open simulator, which knows the spaces; None of a pure environment."""
        if not is_simulated(self.task):
            return None
        task: Any = self.task
        simulator = task.simulator()
        simulator.open()
        return simulator

    @property
    def _first_action(self) -> int:
        return 0 if self._simulator is None else int(self._simulator.actions.start)

    def _is_one(self, observation: Any) -> bool:
        """Whether it is one observation, not several of them."""
        space = None if self._simulator is None else self._simulator.space
        if space is not None and not isinstance(space, spaces.Box):
            return bool(space.contains(observation))
        shape = space.shape if space else (self.task.state_dim,)
        with suppress(ValueError):  # rows of several lengths
            return np.shape(observation) == shape
        return False


@dataclass(frozen=True, eq=False, repr=False)
class Residual:
    """The residual of one stage of an agent."""

    agent: Agent
    own: Q

    def q(self, observations: Any) -> NDArray[np.float64]:
        """Its values (n, A) at n observations."""
        return self.agent.values(self.own, observations)

    def __repr__(self) -> str:
        return f"Residual({self.agent})"
