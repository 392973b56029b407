"""A stage is a task, a learner with its budget, and the transfers into it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Protocol

from bcrl.common.serialization import storable
from bcrl.envs import Env
from bcrl.errors import BcrlError
from bcrl.learning import Floats
from bcrl.learning.folding import Folded
from bcrl.learning.line_search import Searched
from bcrl.learning.rollout import Policy
from bcrl.learning.transfer import Boost, StageInit, StageResult, Transfer, begin, tried
from bcrl.q.functions import ZERO


@dataclass(frozen=True)
class SeedBatch:
    """The seeds that train together, and what they share."""

    seeds: tuple[int, ...]
    probe: Floats  # (n_probe, d) states at which Q is recorded
    threads: int = 1
    device: str = "cpu"


class Learner(Protocol):
    """How a stage is learned; an object of settings, without state."""

    name: ClassVar[str]

    @property
    def length(self) -> int:
        """Iterations or environment steps of a stage."""

    def learn(
        self, stage: "Stage", start: StageInit, batch: SeedBatch, state: Any = None
    ) -> Iterator["Pause"]:
        """Learn `stage`, or resume at a pause's `state`; the last is a Snapshot."""


@dataclass(frozen=True)
class Stage:
    """One slot of a run."""

    number: int  # slot, from 1
    task: int  # position in the environment's task sequence, from 1
    env: Env
    learner: Learner
    transfers: tuple[Transfer, ...]  # from the previous stage
    before: int  # iterations or environment steps of all previous stages
    own_task: int = 0  # its position without the tasks of a source; 0: it is `task`

    @cached_property
    def boost(self) -> Boost:
        """How it uses its base, as far as its transfers tell."""
        if (start := tried(self.transfers)) is not None:
            return Boost() if start.base is ZERO else start.boost
        return next((t for t in self.transfers if isinstance(t, Boost)), Boost())


@dataclass(frozen=True)
class Pause:
    """A point at which learning can be interrupted and resumed."""

    stage: Stage
    count: int  # iterations or environment steps since the run began
    state: Any  # the learner's state, valid until learning continues


@dataclass(frozen=True)
class Snapshot(Pause):
    """A pause at which the learned Q-functions can be evaluated."""

    result: StageResult
    searched: Searched | None = field(default=None, kw_only=True)  # of the base
    folded: Folded | None = field(default=None, kw_only=True)  # how `result` changed
    #: Seeds that cannot continue, by index in the batch, and why.
    failed: dict[int, str] = field(default_factory=dict, kw_only=True)

    @property
    def last_of_stage(self) -> bool:
        """Whether the stage is complete."""
        return self.count == self.stage.before + self.stage.learner.length


@dataclass(frozen=True)
class StepSnapshot(Snapshot):
    """A snapshot of a learner that counts environment steps."""

    policy: Policy  # of 2 · `episodes` lanes: one half explores, the other is greedy
    episodes: int
    loss: Floats  # (S,) mean since the last snapshot; nan without updates


@storable
@dataclass(frozen=True)
class RunState:
    """Stages completed, the last one's result, and the learner's state in the next."""

    stages: int
    result: StageResult | None
    state: Any = None


@dataclass
class CurriculumRun:
    """Learns stages in order; transfers start each one from the result before it."""

    stages: Sequence[Stage]
    batch: SeedBatch
    state: RunState = RunState(0, None)  # with the latest pause's a new run resumes
    ending: RunState | None = None  # from it, a run whose last stage is longer resumes
    earlier: Sequence[Stage] = ()  # of the run whose result the first stage starts from

    def __iter__(self) -> Iterator[Pause]:
        for stage in (s for s in self.stages if s.number > self.state.stages):
            now, learner = self.state, stage.learner
            start = begin(stage.transfers, now.result)
            for pause in learner.learn(stage, start, self.batch, now.state):
                if isinstance(pause, Snapshot) and pause.last_of_stage:
                    self.state = RunState(stage.number, pause.result)
                    if stage is self.stages[-1]:
                        self.ending = RunState(now.stages, now.result, pause.state)
                else:
                    self.state = RunState(now.stages, now.result, pause.state)
                yield pause
            if self.state.stages < stage.number:
                name = getattr(learner, "name", type(learner).__name__)
                why = "must end with a Snapshot whose last_of_stage is true"
                raise BcrlError(f"{name}.learn: stage {stage.number} {why}")

    @property
    def given(self) -> list[Any]:
        """What a stored `state` refers to and does not contain: settings, tasks."""
        found = [ZERO, self.batch]
        for stage in (*self.stages, *self.earlier):
            found += stage.env, *vars(stage.learner).values()
        return found


def learn(stages: Sequence[Stage], batch: SeedBatch) -> Iterator[Snapshot]:
    """The snapshots of a whole run."""
    run = CurriculumRun(stages, batch)
    return (pause for pause in run if isinstance(pause, Snapshot))
