"""For tests: a corridor with a goal at one end, and stages by themselves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bcrl.stage import Stage, Team


@dataclass(frozen=True)
class Corridor:
    """Walk left (0) or right (1) along cells 0 … 5; the last cell pays `prize`."""

    prize: float = 1.0
    gamma: float = 0.9
    horizon: int = 30

    name: ClassVar[str] = "corridor"
    n_actions: ClassVar[int] = 2
    state_dim: ClassVar[int] = 1
    initial_noise: ClassVar[int] = 1
    step_noise: ClassVar[int] = 0
    finite: ClassVar[bool] = True

    def initial(self, noise):
        return np.floor(noise * 5)

    def step(self, state, action, noise=None):
        after = np.clip(state + (2 * action[..., None] - 1), 0, 5)
        absorbing = after[..., 0] == 5
        return after, np.where(absorbing, self.prize, -0.1), absorbing

    def evaluation_states(self):
        return np.zeros((1, 1))

    def states(self):
        return np.arange(6.0)[:, None]

    def index(self, state):
        return np.asarray(state)[..., 0].astype(np.intp)


@dataclass(frozen=True)
class OpenCorridor(Corridor):
    """The same corridor without its list of states being used: not tabulated."""

    finite: ClassVar[bool] = False


def staged(learner, env, number=1, before=0):
    """A stage of `learner` in `env` by itself."""
    return Stage(number, number, env, learner, (), before)


def team(*seeds):
    """Seeds that train together, with nothing to look at."""
    return Team(seeds, np.zeros((1, 1)))


def last(moments):
    """The last of what a learner yields, evaluating none."""
    *_, moment = moments
    return moment
