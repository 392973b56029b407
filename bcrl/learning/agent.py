"""What one seed has learned, as an agent that values and chooses actions."""

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import iterate
from numpy.typing import NDArray

from bcrl.envs import Env, is_simulated
from bcrl.envs.gym_api import GymEnv
from bcrl.errors import BcrlError
from bcrl.learning import Floats, Integers
from bcrl.learning.learned import Learned
from bcrl.learning.policies import combined_actions, greedy
from bcrl.learning.transfer import Acting
from bcrl.q.functions import ZERO, Q


@dataclass(frozen=True)
class Agent:
    """An agent that was loaded: its Q-functions, its task and its run's config."""

    task: Env  # the target that it has learned
    config: dict[str, Any]  # of its run
    seed: int
    learned: Learned

    @property
    def residuals(self) -> tuple["Residual", ...]:
        """ϱ of the stages that were kept; all stages with boosting or keep=stages."""
        return tuple(Residual(self, own) for own in self.learned.residuals)

    def q(self, observations: Any) -> Floats:
        """The values (n, A) of all actions at n observations of the task."""
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
        states = self.states([observation] if alone else observation)
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
        """Observations of the task's Gymnasium environment as vectors (n, d)."""
        simulator = self._simulator
        if simulator is None or isinstance(simulator.members, spaces.Box):
            found = np.asarray(observations, np.float64)
            found = found.reshape(len(found), -1)
        else:
            if isinstance(observations, (dict, tuple)):
                observations = iterate(simulator.space, observations)
            each = [simulator.vector("observation", one) for one in observations]
            found = np.array(each).reshape(-1, self.task.state_dim)
        if found.shape[1:] != (d := self.task.state_dim,):
            what = f"observations with {found.shape[-1]} numbers"
            raise BcrlError(f"{what}; {self.task.name} has {d}: pass (n, {d})")
        return found

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
        """Whether it is one observation, not an array of them."""
        space = None if self._simulator is None else self._simulator.space
        if space is None or isinstance(space, spaces.Box):
            return np.ndim(observation) == (len(space.shape) if space else 1)
        return bool(space.contains(observation))


@dataclass(frozen=True)
class Residual:
    """The residual of one stage of an agent."""

    agent: Agent
    own: Q

    def q(self, observations: Any) -> NDArray[np.float64]:
        """Its values (n, A) at n observations."""
        return self.agent.values(self.own, observations)
