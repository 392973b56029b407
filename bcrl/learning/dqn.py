"""Deep Q-network (Mnih et al. 2015) for S seeds in lockstep, plain or boosted."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

from bcrl.learning.stage import Pause, SeedBatch, Stage
from bcrl.learning.transfer import StageInit


@dataclass(frozen=True)
class DQN:
    """DQN's settings for one stage; steps are environment steps (paper, C.3).

    `random_steps` uniformly random steps come before the `steps`. ε falls from
    `epsilon_start` to `epsilon` within the first `anneal_steps` of the `steps`. Each
    step makes one update once the replay holds more than `learning_starts` transitions.
    Every `target_update` steps, random ones included, the target network is copied.
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
        trained, over = step - self.random_steps, self.anneal_steps
        if trained < 0:
            return 1.0
        if trained >= over:
            return self.epsilon
        return self.epsilon_start + (self.epsilon - self.epsilon_start) * trained / over

    def learn(
        self, stage: Stage, start: StageInit, batch: SeedBatch, state: Any = None
    ) -> Iterator[Pause]:
        """Learn a stage; yields a pause or Snapshot at first and after each step."""
        from bcrl.learning.dqn_trainer import DQNTrainer  # torch is slow

        run = DQNTrainer(self, stage, start, batch, state)
        if state is None:
            yield run.pause()
        while run.state.step < self.length:
            run.act()
            if run.state.replay.size > self.learning_starts:
                run.update()
            run.end_step()
            yield run.pause()
