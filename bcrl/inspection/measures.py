"""What the residuals of one seed's agent are worth, in numbers.

Everything is measured where the run's data lay: FQI's data are collected again, from
the same random streams; for other learners the agent plays as it did at the stage's
end.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from bcrl.common.seeding import stream
from bcrl.envs import Env, is_simulated
from bcrl.evaluation import oracle
from bcrl.inspection.stack import Stack
from bcrl.learning import Booleans, Floats, dataset
from bcrl.learning.dataset import Dataset
from bcrl.learning.fqi import FQI
from bcrl.learning.rollout import (
    Episodes,
    draws,
    rollout,
    starts_and_draws,
    success_of,
)
from bcrl.learning.stage import SeedBatch, Stage
from bcrl.learning.transfer import StageInit, StageResult
from bcrl.q.functions import Q

PLAYED = 20  # episodes that stand for the data of learners that keep none
#: Kinds of ablations: the agent as it is, without one residual, as after a stage.
WHOLE, WITHOUT, UPTO = "whole", "without", "upto"


def values(q: Q, states: Floats, n_actions: int) -> Floats:
    """Values (n, A) of one seed's Q-function at states (n, d)."""
    return np.asarray(q(states[None].astype(np.float64), n_actions))[0]


@dataclass
class Inspection:
    """The measurements of one seed."""

    stack: Stack
    episodes: int = 50  # of each ablation, where episodes start at random

    @cached_property
    def visits(self) -> list[Dataset]:
        """The data of each stage."""
        nothing = np.empty((0, self._target.state_dim))
        batch = SeedBatch((self.stack.agent.seed,), nothing)
        found, before, data = [], None, None
        for stage in self.stack.stages:
            learner, now = stage.learner, self.stack.upto(stage.number)
            if isinstance(learner, FQI):
                past = None if before is None else StageResult(before, before, data)
                data = learner.collect(stage, StageInit(past), batch).data
                found.append(data[0])
            else:
                played = self._played(stage, now)
                found.append(dataset.build(stage.env, played, 0, nothing))
            before = now
        return found

    def _played(self, stage: Stage, q: Q) -> Episodes:
        """Episodes of the agent as it was at a stage's end, exploring as it did."""
        rngs = [stream(self.stack.agent.seed, "inspection", stage.number)]
        epsilon = getattr(stage.learner, "evaluation_epsilon", 0.0)
        return rollout(
            stage.env, q, *starts_and_draws(rngs, stage.env, PLAYED), epsilon
        )

    def stages(self) -> pd.DataFrame:
        """A row per stage: sizes of ϱ, what it decides, and errors of Q."""
        return pd.DataFrame(map(self._stage, self.stack.stages, self.visits))

    def _stage(self, stage: Stage, seen: Dataset) -> dict[str, Any]:
        env, stack, n = stage.env, self.stack, stage.number
        q = stack.upto(n)
        base = stack.base(n, stack.upto(n - 1))
        own, under, whole = (
            values(each, seen.points, env.n_actions)
            for each in (stack.residuals[n - 1], base, q)
        )
        at, w = (seen.state, seen.action), seen.multiplicity / seen.multiplicity.sum()
        changed = (
            _new_choice(under, whole)[seen.state] if n > 1 else np.full(len(w), np.nan)
        )
        after = np.where(seen.absorbing, 0.0, whole[seen.next_state].max(-1))
        bellman = np.abs(seen.reward + env.gamma * after - whole[at])
        return {
            "seed": stack.agent.seed,
            "stage": n,
            "task": stage.task,
            "alpha": stack.alphas[n - 1],
            "residual_l1": float(w @ np.abs(own[at])),
            "residual_l2": float(np.sqrt(w @ own[at] ** 2)),
            "residual_sup": float(np.abs(own[at]).max()),
            "base_l2": float(np.sqrt(w @ under[at] ** 2)),
            "greedy_changed": float(w @ changed),
            "bellman_error": float(w @ bellman),
            "q_error": q_error(env, q),
        }

    def ablations(self) -> pd.DataFrame:
        """A row per ablation, measured in the target task."""
        n = len(self.stack.stages)
        asked = [(WHOLE, n, self.stack.upto(n))]
        asked += [(WITHOUT, t, self.stack.upto(n, t)) for t in range(1, n + 1)]
        asked += [(UPTO, t, self.stack.upto(t)) for t in range(1, n)]
        seen = self.visits[-1]
        whole = values(asked[0][2], seen.points, self._target.n_actions)
        w = np.bincount(seen.state, seen.multiplicity, len(seen.points))
        w /= w.sum()
        rows = []
        for kind, stage, q in asked:
            now = values(q, seen.points, self._target.n_actions)
            row = {"seed": self.stack.agent.seed, "kind": kind, "stage": stage}
            row |= self._outcome(q)
            row |= {"greedy_changed": float(w @ _new_choice(whole, now))}
            rows.append(row | {"q_error": q_error(self._target, q)})
        return pd.DataFrame(rows)

    def _outcome(self, q: Q) -> dict[str, float]:
        """The mean return of greedy episodes in the target and the share that solve."""
        env, rngs = self._target, [stream(self.stack.agent.seed, "inspection")]
        if isinstance(self.stack.stages[-1].learner, FQI) and not is_simulated(env):
            start = env.evaluation_states()[None]  # those of the CSV's returns
            u = draws(rngs, env, start.shape[1])
        else:
            start, u = starts_and_draws(rngs, env, self.episodes)
        played = rollout(env, q, start, u)
        return {
            "return": float(played.reward[0].sum(-1).mean()),
            "discounted_return": float(played.discounted_return(env.gamma).mean()),
            "solved": float(played.solved(success_of(env)).mean()),
        }

    def contributions(self, states: Floats) -> Iterator[Floats]:
        """What each ϱ_t adds to V(s) = max_a Q(s, a) at n states, (n,) per stage.

        It is ϱ_t at the greedy action, times the later stages' factors.
        """
        stack, n_actions = self.stack, self._target.n_actions
        best = values(stack.upto(len(stack.stages)), states, n_actions).argmax(-1)
        factor = np.append(np.cumprod(stack.alphas[:0:-1])[::-1], 1.0)
        for own, alpha in zip(stack.residuals, factor, strict=True):
            yield alpha * values(own, states, n_actions)[np.arange(len(states)), best]

    @property
    def _target(self) -> Env:
        return self.stack.agent.task


def q_error(env: Env, q: Q) -> float:
    """Mean |Q − Q*| where Q* of a task is known; nan elsewhere."""
    if (known := oracle.reference(env)) is None:
        return np.nan
    return float(np.abs(values(q, known.states, env.n_actions) - known.q).mean())


def _new_choice(before: Floats, after: Floats) -> Booleans:
    """Whether the greedy action after, (n, A), was not greedy before: (n,)."""
    chosen = after.argmax(-1)
    return before[np.arange(len(before)), chosen] < before.max(-1)
