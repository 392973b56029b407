"""Metrics of learners that count environment steps, from complete episodes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bcrl.common.seeding import stream
from bcrl.evaluation.metrics import probed_states
from bcrl.evaluation.probe import SeedProbe
from bcrl.learning import Floats
from bcrl.learning.rollout import CHOICES, Episodes, play, starts_and_draws, success_of
from bcrl.learning.stage import StepSnapshot


def evaluate(now: StepSnapshot, seeds: Sequence[int]) -> list[dict[str, float]]:
    """Each seed's columns (docs/reference/metrics.md), in the stage's unshaped task."""
    return _evaluate(now, seeds)[0]


def _evaluate(
    now: StepSnapshot, seeds: Sequence[int]
) -> tuple[list[dict[str, float]], Episodes]:
    """Each seed's columns, and their episodes: exploring ones, then greedy ones.

    Both policies get the same starts and the same noise, which depend on seed, stage
    and step alone: evaluation does not change training.
    """
    env, n = now.stage.env, now.episodes
    path = (now.stage.number, now.count - now.stage.before)
    rngs = [stream(seed, "evaluation", *path) for seed in seeds]
    start, u = starts_and_draws(rngs, env, n, CHOICES)
    played = play(env, now.policy, np.tile(start, (1, 2, 1)), np.tile(u, (1, 1, 2, 1)))
    outcomes = {
        "return": played.reward.sum(-1),
        "discounted_return": played.discounted_return(env.gamma),
        "success_rate": played.solved(success_of(env)),
    }
    first = np.ascontiguousarray(played.state[:, :n, 0])  # observed, unlike `start`
    q: Any = now.result.q
    best = np.asarray(q(first, env.n_actions)).max(-1)
    rows = [
        {name: float(values[s, :n].mean()) for name, values in outcomes.items()}
        | {"q_mean": float(best[s].mean()), "loss": float(now.loss[s])}
        | {f"greedy_{k}": float(values[s, n:].mean()) for k, values in outcomes.items()}
        for s in range(len(seeds))
    ]
    for s in played.failed:  # void, except for the loss
        rows[s] |= dict.fromkeys(rows[s].keys() - {"loss"}, np.nan)
    return rows, played


class StepProbe(SeedProbe):
    """Measures the snapshots of DQN and LSPI."""

    index = "step"

    @cached_property
    def states(self) -> Floats:
        target = self.target
        return target.plane() if hasattr(target, "plane") else probed_states(target)

    def measure(self, snapshot: StepSnapshot) -> list[dict[str, float]]:
        """Each seed's row of the CSV."""
        rows, played = _evaluate(snapshot, self.seeds)
        self.failed = played.failed | snapshot.failed
        if snapshot.last_of_stage:
            self._shown = played, snapshot.episodes  # the first greedy one
            states = np.broadcast_to(self.states, (len(rows), *self.states.shape))
            q: Any = snapshot.result.q
            values = np.asarray(q(states, snapshot.stage.env.n_actions), np.float32)
            self.kept.append((snapshot.stage.learner.name, values))
        return rows

    def final(self, s: int) -> dict[str, NDArray]:
        stages = np.stack([q[s] for _, q in self.kept])
        return {"states": self.states, "q": stages[-1], "q_stages": stages}

    def shown(self) -> tuple[Episodes, int]:
        return self._shown

    def facts(self) -> dict[str, Any]:
        return {"learners": [name for name, _ in self.kept]}
