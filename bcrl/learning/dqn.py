"""Deep Q-network (Mnih et al. 2015) for many seeds in lockstep, plain or boosted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

from bcrl.learning.lockstep import DQNTrainer
from bcrl.learning.policies import annealed
from bcrl.learning.stage import Pause, SeedBatch, Stage
from bcrl.learning.transfer import StageInit


@dataclass(frozen=True)
class DQN:
    """DQN's settings for one stage; steps are environment steps (paper, C.3).

    `random_steps` uniformly random ones come before the `steps`. ε falls from
    `epsilon_start` to `epsilon` over the first `anneal_steps` of the steps. One update
    comes with each step once the replay holds more than `learning_starts` transitions;
    the target is copied every `target_update` steps, random ones counted.
    """

    steps: int = 10_000
    random_steps: int = 500
    learning_starts: int = 500
    epsilon: float = 0.1
    epsilon_start: float = 0.1
    anneal_steps: int = 0
    target_update: int = 200
    batch_size: int = 32
    replay_size: int = 10_000
    hidden: tuple[int, ...] = (128, 128)
    learning_rate: float = 1e-4
    evaluate_every: int = 1000
    evaluation_episodes: int = 34
    evaluation_epsilon: float = 0.1

    name: ClassVar[str] = "dqn"

    @property
    def length(self) -> int:
        """Environment steps of a stage."""
        return self.random_steps + self.steps

    def epsilon_at(self, step: int) -> float:
        """ε in a step of the stage, counted from 0."""
        trained = step - self.random_steps
        if trained < 0:
            return 1.0
        return annealed(trained, self.epsilon_start, self.epsilon, self.anneal_steps)

    def is_evaluated(self, step: int) -> bool:
        """Whether there is something to see after `step` steps of a stage."""
        trained = step - self.random_steps
        due = trained >= 0 and trained % self.evaluate_every == 0
        return due or step == self.length

    def learn(
        self, stage: Stage, start: StageInit, team: SeedBatch, state: Any = None
    ) -> Iterator[Pause]:
        """Learn a stage; yields before the first step and after each.

        There is a moment to see before the first that isn't random, after every
        `evaluate_every` and after the last.
        """
        run = DQNTrainer(self, stage, start, team, state)
        if state is None:
            yield run.pause()
        while run.step < self.length:
            run.act()
            if run.replay.size > self.learning_starts:
                run.update()
            run.end_step()
            yield run.pause()
