"""What the probes of all learners share: a probe measures snapshots of some seeds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bcrl.learning.rollout import Episodes
from bcrl.learning.stage import Snapshot


class SeedProbe(ABC):
    """Measures the snapshots of several seeds, and keeps what each stage ends with."""

    index: ClassVar[str]  # the CSV's name for a snapshot's count

    def __init__(self, seeds: Sequence[int], tasks: Sequence[Any]) -> None:
        self.seeds, self.tasks = seeds, tasks
        self.target = tasks[-1]
        self.kept: list[Any] = []  # by stage, recorded at its end; checkpoints store it
        #: Seeds, by index, that can't continue after the latest measurement, and why.
        self.failed: dict[int, str] = {}

    @abstractmethod
    def measure(self, snapshot: Any) -> list[dict[str, float]]:
        """Each seed's metrics, by column of the CSV."""

    def place(self, snapshot: Snapshot) -> dict[str, int]:
        """The first columns of a snapshot's rows: stage, task and count."""
        stage = snapshot.stage
        count = {self.index: snapshot.count}
        return {"stage": stage.number, "task": stage.task} | count

    @abstractmethod
    def final(self, s: int) -> dict[str, NDArray]:
        """`states` (n, d), and what the seed with index s has learned there."""

    @abstractmethod
    def shown(self) -> tuple[Episodes, int]:
        """Final episodes of all seeds, and the index of the one to store."""

    @abstractmethod
    def facts(self) -> dict[str, Any]:
        """What the metadata says about the measurements."""

    def arrays(self, s: int) -> dict[str, NDArray]:
        """The NPZ of the seed with index s: what it learned, an episode, the scene."""
        episodes, e = self.shown()
        length, found, target = episodes.length[s, e], self.final(s), self.target
        found["trajectory"] = episodes.state[s, e, : length + 1]  # (T + 1, d)
        found["trajectory_actions"] = episodes.action[s, e, :length]  # (T,) or (T, k)
        found["trajectory_start"] = episodes.start[s, e]  # what reset a simulator
        if hasattr(target, "walls"):
            walls = np.stack([task.walls for task in self.tasks])
            return found | {"walls": walls, "goal": target.goal}
        return found | (target.scene() if hasattr(target, "scene") else {})
