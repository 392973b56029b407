"""A stage: a task, a learner with its budget, and what is transferred into it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from bcrl.envs import Env
from bcrl.rollout import Policy
from bcrl.transfer import Learned, Start, Transfer, begin


@dataclass(frozen=True)
class Team:
    """The seeds that train together, and what they have to do it with."""

    seeds: tuple[int, ...]
    probe: NDArray[np.float64]  # (n_probe, d) states at which Q is looked at
    threads: int = 1
    device: str = "cpu"


@dataclass(frozen=True)
class Snapshot:
    """What a team knows at one moment of a stage."""

    stage: Stage
    count: int  # iterations or environment steps, over the whole run
    last_of_stage: bool
    learned: Learned

    @property
    def failed(self) -> dict[int, str]:
        """Which of the S seeds can't go on, and why."""
        return {}


@dataclass(frozen=True)
class Moment(Snapshot):
    """A snapshot of a learner that counts environment steps."""

    policy: (
        Policy  # of twice `episodes` lanes: explores in half of them, then is greedy
    )
    episodes: int
    loss: NDArray[np.float64]  # (S,) mean since the last moment; nan without updates
    failures: dict[int, str] = field(default_factory=dict)

    @property
    def failed(self) -> dict[int, str]:
        return self.failures


class Learner(Protocol):
    """How a stage is learned; an object of settings, without state."""

    name: ClassVar[str]

    @property
    def length(self) -> int:
        """Iterations or environment steps that a stage takes."""

    def learn(self, stage: Stage, start: Start, team: Team) -> Iterator[Snapshot]:
        """Learn `stage` from `start`, yielding whenever there is something to see."""


@dataclass(frozen=True)
class Stage:
    """One slot of a run."""

    number: int  # slot, from 1
    task: int  # position in the environment's task sequence, from 1
    env: Env
    learner: Learner
    transfers: tuple[Transfer, ...]  # from the stage before
    before: int  # iterations or environment steps of the stages before


def learn(stages: Sequence[Stage], team: Team) -> Iterator[Snapshot]:
    """Learn the stages in order, each started by its transfers from the one before."""
    learned = None
    for stage in stages:
        start = begin(stage.transfers, learned)
        for now in stage.learner.learn(stage, start, team):
            yield now
        learned = now.learned
