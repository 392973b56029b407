"""Metrics of learners that count environment steps, from complete episodes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bcrl.common.seeding import stream
from bcrl.evaluation.metrics import SeedProbe, probed_states
from bcrl.learning.rollout import CHOICES, Episodes, play, starts_and_draws, success_of
from bcrl.learning.stage import StepSnapshot


def evaluate(
    now: StepSnapshot, seeds: Sequence[int]
) -> tuple[list[dict[str, float]], Episodes]:
    """Each seed's columns (docs/reference/metrics.md) in the unshaped task.

    Also their episodes: exploring ones, then greedy ones, from the same starts and with
    the same noise. These depend on seed, stage and step alone.
    """
    env, n, step = now.stage.env, now.episodes, now.count - now.stage.before
    rngs = [stream(seed, "evaluation", now.stage.number, step) for seed in seeds]
    start, u = starts_and_draws(rngs, env, n, CHOICES)
    played = play(env, now.policy, np.tile(start, (1, 2, 1)), np.tile(u, (1, 1, 2, 1)))
    outcomes = {
        "return": played.reward.sum(-1),
        "discounted_return": played.discounted_return(env.gamma),
        "success_rate": played.solved(success_of(env)),
    }
    first = np.ascontiguousarray(played.state[:, :n, 0])  # observed, unlike `start`
    best = np.asarray(now.result.q(first, env.n_actions)).max(-1)
    rows = []
    for s in range(len(seeds)):
        row = {name: values[s, :n].mean() for name, values in outcomes.items()}
        row |= {"q_mean": best[s].mean(), "loss": now.loss[s]}
        row |= {f"greedy_{name}": x[s, n:].mean() for name, x in outcomes.items()}
        if s in played.failed:  # void, except for the loss
            row = dict.fromkeys(row, np.nan) | {"loss": now.loss[s]}
        rows.append({name: float(value) for name, value in row.items()})
    return rows, played


class StepProbe(SeedProbe):
    """Measures the snapshots of DQN and LSPI."""

    index = "step"

    def __init__(self, seeds: Sequence[int], tasks: Sequence[Any]) -> None:
        super().__init__(seeds, tasks)
        plane = getattr(self.target, "plane", None)
        self.states = plane() if plane else probed_states(self.target)

    def measure(self, snapshot: StepSnapshot) -> list[dict[str, float]]:
        """Each seed's row of the CSV."""
        rows, played = evaluate(snapshot, self.seeds)
        self.failed = played.failed | snapshot.failed
        if snapshot.last_of_stage:
            self._played = played
            states = np.broadcast_to(self.states, (len(rows), *self.states.shape))
            q = snapshot.result.q(states, snapshot.stage.env.n_actions)
            self.kept.append((snapshot.stage.learner.name, np.asarray(q, np.float32)))
        return rows

    def arrays(self, s: int) -> dict[str, NDArray]:
        """The NPZ of the seed with index s: what it learned, an episode, the scene."""
        stages, played = np.stack([q[s] for _, q in self.kept]), self._played
        found = {"states": self.states, "q": stages[-1], "q_stages": stages}
        first_greedy = played.length.shape[1] // 2
        return found | self.shown(played, s, first_greedy)

    def facts(self) -> dict[str, Any]:
        """What the metadata says about the measurements."""
        return {"learners": [name for name, _ in self.kept]}
