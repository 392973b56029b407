"""Evaluation of learners that count steps: complete episodes, streams of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bcrl.common.seeding import stream
from bcrl.envs import Env
from bcrl.evaluation.metrics import probed_states, scene, trajectory
from bcrl.learning.rollout import CHOICES, Episodes, play, start_states, success_of
from bcrl.learning.stage import StepSnapshot


def evaluate(now: StepSnapshot, seeds: Sequence[int]) -> list[dict[str, float]]:
    """Each seed's columns of docs/metrics.md, in the unwrapped task of the stage."""
    return _evaluate(now, seeds)[0]


def _evaluate(
    now: StepSnapshot, seeds: Sequence[int]
) -> tuple[list[dict[str, float]], Episodes]:
    """Each seed's columns, and the episodes behind them: exploring, then greedy ones.

    Both policies meet the same starts and the same noise, which depend on seed, stage
    and step alone: evaluating changes no training.
    """
    env, n = now.stage.env, now.episodes
    rngs = [
        stream(seed, "evaluation", now.stage.number, now.count - now.stage.before)
        for seed in seeds
    ]
    start = np.stack([start_states(rng, env, n) for rng in rngs])
    shape = (env.horizon, n, CHOICES + env.step_noise)
    u = np.stack([rng.random(shape) for rng in rngs])
    played = play(env, now.policy, np.tile(start, (1, 2, 1)), np.tile(u, (1, 1, 2, 1)))
    outcomes = {
        "return": played.reward.sum(-1),
        "discounted_return": played.discounted_return(env.gamma),
        "success_rate": played.solved(success_of(env)),
    }
    first = np.ascontiguousarray(played.state[:, :n, 0])  # what was seen, not `start`
    best = np.asarray(now.learned.q(first, env.n_actions)).max(-1)
    rows = [
        {name: float(values[s, :n].mean()) for name, values in outcomes.items()}
        | {"q_mean": float(best[s].mean()), "loss": float(now.loss[s])}
        | {f"greedy_{k}": float(values[s, n:].mean()) for k, values in outcomes.items()}
        for s in range(len(seeds))
    ]
    for s in played.failed:  # void, but for the loss
        rows[s] |= dict.fromkeys(rows[s].keys() - {"loss"}, np.nan)
    return rows, played


@dataclass
class StepProbe:
    """Measures moments of several seeds; keeps each stage's Q at its end."""

    seeds: Sequence[int]
    tasks: Sequence[Env]
    #: At each stage's end: who has learned it, and Q at `states` (S, n, A).
    kept: list[tuple[str, NDArray[np.float32]]] = field(default_factory=list)
    #: By place, which seeds can't go on after the latest measurement, and why.
    failed: dict[int, str] = field(default_factory=dict)

    index: ClassVar[str] = "step"  # what a moment's count is

    @cached_property
    def states(self) -> NDArray[np.float64]:
        """The states (n, d) at which Q is kept, for figures."""
        target = self.tasks[-1]
        return target.plane() if hasattr(target, "plane") else probed_states(target)

    def measure(self, now: StepSnapshot) -> list[dict[str, float]]:
        """Each seed's row of the CSV."""
        rows, played = _evaluate(now, self.seeds)
        self.failed = played.failed | now.failed
        if now.last_of_stage:
            self._shown, self._first = played, now.episodes  # the first greedy one
            env, n = now.stage.env, len(self.seeds)
            asked = np.broadcast_to(self.states, (n, *self.states.shape))
            q = np.asarray(now.learned.q(asked, env.n_actions), np.float32)
            self.kept.append((now.stage.learner.name, q))
        return rows

    def arrays(self, s: int) -> dict[str, NDArray]:
        """What seed number s ends with: the stages' Q at `states`, an episode."""
        kept = np.stack([q[s] for _, q in self.kept])
        found = {"states": self.states, "q": kept[-1], "q_stages": kept}
        return found | trajectory(self._shown, s, self._first) | scene(self.tasks)

    def facts(self) -> dict[str, Any]:
        """What else is known of the run: the learner of each stage."""
        return {"learners": [name for name, _ in self.kept]}
