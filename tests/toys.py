"""For tests: a corridor with a goal at one end, and stages by themselves."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from bcrl.common.serialization import storable
from bcrl.learning.stage import SeedBatch, Snapshot, Stage


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
    return SeedBatch(seeds, np.zeros((1, 1)))


def snapshots(pauses):
    """The pauses that are snapshots."""
    return (pause for pause in pauses if isinstance(pause, Snapshot))


def last(moments):
    """The last of what a learner yields, evaluating none."""
    *_, moment = moments
    return moment


@dataclass(frozen=True)
class Simulated(OpenCorridor):
    """The corridor as a simulator; episodes reset by a `doomed` number fail early."""

    doomed: tuple[float, ...] = ()
    starts: int = 4

    def initial(self, noise):
        return noise  # what resets a lane, no state

    def evaluation_states(self):
        return self.lanes().begin((np.arange(self.starts)[:, None] + 0.5) / self.starts)

    def lanes(self):
        return SimulatedLanes(self)

    def check_tasks(self, tasks):
        pass


@storable
@dataclass(eq=False)
class SimulatedLanes:
    """Lanes of `Simulated`, as `bcrl.envs.base.Lanes` says."""

    env: Simulated
    number: np.ndarray | None = None  # (…) what each lane was reset by
    steps: np.ndarray | None = None  # (…)
    failures: dict[int, str] = field(default_factory=dict)

    def begin(self, start):
        self.number, self.steps = start[..., 0].copy(), np.zeros(start.shape[:-1], int)
        return np.floor(start * 5)

    def step(self, state, action, noise, lanes=...):
        after, reward, absorbing = self.env.step(state, action)
        self.steps[lanes] += 1
        places = np.arange(self.steps.size).reshape(self.steps.shape)[lanes]
        fails = np.isin(self.number, self.env.doomed) & (self.steps >= 1)
        fails[lanes] |= np.isin(places, list(self.failures))
        for place in places[fails[lanes]].tolist():
            self.failures.setdefault(place, "step failed: it broke")
        lost = fails[lanes]
        after[lost], reward[lost], absorbing[lost] = 0.0, 0.0, False
        return after, reward, absorbing, lost

    def restart(self, over, start, state):
        places = np.arange(self.steps.size).reshape(self.steps.shape)
        again = over & ~np.isin(places, list(self.failures))
        self.number[again], self.steps[again] = start[..., 0][again], 0
        return np.where(again[..., None], np.floor(start * 5), state)

    def close(self):
        pass


def same(observation: np.ndarray) -> np.ndarray:
    """An observation as it is, for `start.observation`."""
    return observation


def doubled(observation: np.ndarray) -> np.ndarray:
    """Twice an observation, for `env.observation`: mapping it again changes it."""
    return 2.0 * observation
