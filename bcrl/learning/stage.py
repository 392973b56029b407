"""A stage: a task, a learner with its budget, and what is transferred into it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from bcrl.common.serialization import storable
from bcrl.envs import Env
from bcrl.errors import BcrlError
from bcrl.learning.rollout import Policy
from bcrl.learning.transfer import StageInit, StageResult, Transfer, begin
from bcrl.q.functions import ZERO


@dataclass(frozen=True)
class SeedBatch:
    """The seeds that train together, and what they have to do it with."""

    seeds: tuple[int, ...]
    probe: NDArray[np.float64]  # (n_probe, d) states at which Q is looked at
    threads: int = 1
    device: str = "cpu"


@dataclass(frozen=True)
class Pause:
    """A moment at which learning may be interrupted and gone on with later."""

    stage: Stage
    count: int  # iterations or environment steps, over the whole run
    state: Callable[[], Any]  # what the learner needs besides the stage and its start


@dataclass(frozen=True)
class Snapshot(Pause):
    """What a team knows at one moment of a stage."""

    last_of_stage: bool
    learned: StageResult
    #: Which of the S seeds can't go on, by place in the team, and why.
    failed: dict[int, str] = field(default_factory=dict, kw_only=True)


@dataclass(frozen=True)
class StepSnapshot(Snapshot):
    """A snapshot of a learner that counts environment steps."""

    policy: (
        Policy  # of twice `episodes` lanes: explores in half of them, then is greedy
    )
    episodes: int
    loss: NDArray[np.float64]  # (S,) mean since the last moment; nan without updates


class Learner(Protocol):
    """How a stage is learned; an object of settings, without state."""

    name: ClassVar[str]

    @property
    def length(self) -> int:
        """Iterations or environment steps that a stage takes."""

    def learn(
        self, stage: Stage, start: StageInit, team: SeedBatch, state: Any = None
    ) -> Iterator[Pause]:
        """Learn `stage` from `start`, yielding whenever there is something to see.

        The last pause is a snapshot. `state`: a pause's, to go on from it; what comes
        is then the same as if there had been no interruption.
        """


@dataclass(frozen=True)
class Stage:
    """One slot of a run."""

    number: int  # slot, from 1
    task: int  # position in the environment's task sequence, from 1
    env: Env
    learner: Learner
    transfers: tuple[Transfer, ...]  # from the stage before
    before: int  # iterations or environment steps of the stages before


@storable
@dataclass(frozen=True)
class RunState:
    """Where a run is: how many stages are done, what they left, and the next's state.

    It refers to what is being learned, so store it before learning goes on.
    """

    stages: int
    learned: StageResult | None
    state: Any = None


class CurriculumRun:
    """Stages learned in order, each started by its transfers from the one before."""

    def __init__(
        self, stages: Sequence[Stage], team: SeedBatch, past: RunState | None = None
    ) -> None:
        self.stages, self.team = stages, team
        self._past = past or RunState(0, None)
        self._now: Pause | None = None

    def __iter__(self) -> Iterator[Pause]:
        for stage in self.stages[self._past.stages :]:
            start, state = begin(stage.transfers, self._past.learned), self._past.state
            now = None
            for now in stage.learner.learn(stage, start, self.team, state):
                self._now = now
                yield now
            if not (isinstance(now, Snapshot) and now.last_of_stage):
                text = "must yield a last Snapshot, with last_of_stage=True"
                name = getattr(stage.learner, "name", type(stage.learner).__name__)
                raise BcrlError(f"{name}.learn: stage {stage.number} {text}")
            self._past = RunState(stage.number, now.learned)

    @property
    def past(self) -> RunState:
        """All that it takes to go on from the latest pause."""
        now = self._now
        if now is None:
            return self._past
        if isinstance(now, Snapshot) and now.last_of_stage:
            return RunState(now.stage.number, now.learned)
        return replace(self._past, state=now.state())

    @property
    def given(self) -> list[Any]:
        """What a stored `past` refers to: settings and environments, the team."""
        settings = (
            part
            for stage in self.stages
            for part in (stage.env, *vars(stage.learner).values())
        )
        return [ZERO, self.team, *settings]


def snapshots(pauses: Iterable[Pause]) -> Iterator[Snapshot]:
    """Those of the pauses at which there is something to see."""
    return (now for now in pauses if isinstance(now, Snapshot))


def learn(stages: Sequence[Stage], team: SeedBatch) -> Iterator[Snapshot]:
    """The snapshots of a whole course."""
    return snapshots(CurriculumRun(stages, team))
