"""Fitted Q-iteration, plain or boosted: every stage learns a residual on a base."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bcrl.common.seeding import stream
from bcrl.envs import is_finite, is_simulated
from bcrl.learning import dataset, rollout
from bcrl.learning.bellman import residual_target, shaping
from bcrl.learning.stage import SeedBatch, Snapshot, Stage
from bcrl.learning.transfer import StageInit, StageResult
from bcrl.q.functions import NOT_FINITE, ZERO, Table, Values, ask
from bcrl.q.regressors.base import Fitted, FittedQ, Problem, Regressor, fit_each


@dataclass(frozen=True)
class Iteration(Snapshot):
    """What FQI knows after one iteration."""

    probed_q: Values  # S arrays (n_probe, A): Q at the probed states
    probed_residual: Values  # S arrays (n_probe, A): ϱ there


@dataclass(frozen=True)
class FQI:
    """Fitted Q-iteration for many seeds at once (Ernst et al. 2005; paper, Eq. 5).

    One iteration refits, for every seed and action, a regressor from scratch to
    `r + γ max_a' Q(s', a') − base(s, a)`. What a stage keeps fixed is computed once:
    its distinct points, which rows belong to which action, the base's values there,
    what shaping adds to the rewards.
    """

    iterations: int
    episodes: int
    regressor: Regressor
    epsilon: float = 1.0  # the data's exploration, ε-greedy on the Q learned so far
    new_data: bool = True  # else the previous stage's data are learned from again
    shared_data: bool = False  # [released] one dataset a task for all seeds
    fixed_trees: bool = False  # [released] the same randomness in every fit of a seed

    name: ClassVar[str] = "fqi"

    @property
    def length(self) -> int:
        """Iterations of a stage."""
        return self.iterations

    def learn(
        self, stage: Stage, start: StageInit, team: SeedBatch, state: Any = None
    ) -> Iterator[Iteration]:
        """Learn a stage, ϱ ← S(T(base + ϱ) − base); yields after each iteration."""
        done, sets, residual, failed = state or (0, *self._data(stage, start, team))
        env, points = stage.env, [d.points for d in sets]
        base, lost = ask(start.base, points, env.n_actions)
        failed = lost | failed
        if residual is None:
            residual, lost = ask(start.initial, points, env.n_actions)
            failed = lost | failed
        potential, lost = ask(start.potential, points, env.n_actions)
        failed = lost | failed
        potential_value = [v.max(-1) for v in potential]
        rewards = [
            d.reward + shaping(v[d.state], v[d.next_state], d.absorbing, env.gamma)
            for d, v in zip(sets, potential_value, strict=True)
        ]
        models = (
            [list(row) for row in start.initial.models]
            if isinstance(start.initial, FittedQ)
            else [[None] * env.n_actions for _ in sets]
        )
        # With noise no state comes twice; the next stage's base should not remember.
        noisy = env.step_noise or is_simulated(env)
        pointwise = getattr(self.regressor, "pointwise", False)
        evaluated = start.memoized() if pointwise and not noisy else start
        for k in range(done + 1, self.iterations + 1):
            residual = [values.copy() for values in residual]
            problems = self._problems(stage, k, team, rewards, sets, base, residual)
            # A seed that failed keeps its last good ϱ; nobody learns from it any more.
            problems = {
                cell: p for cell, p in problems.items() if cell[0] not in failed
            }
            keep = not is_finite(env)  # a table is never asked between its points
            fits, lost = fit_each(self.regressor, problems, keep, team.threads)
            failed = lost | failed
            for (s, a), fit in fits.items():
                part, problem = sets[s].by_action[a], problems[s, a]
                residual[s][sets[s].state[part.rows], a] = fit.fitted
                residual[s][part.query_points, a] = fit.queried
                models[s][a] = Fitted.of(problem, fit)
            q = [b + r for b, r in zip(base, residual, strict=True)]
            if start.shape is not None:
                q = [x + v[:, None] for x, v in zip(q, potential_value, strict=True)]
            lost = {s for s, x in enumerate(q) if not np.isfinite(x).all()}
            failed = dict.fromkeys(lost, NOT_FINITE) | failed
            if is_finite(env):
                learned = StageResult(Table(q, env), Table(residual, env), sets)
            else:
                own = FittedQ([tuple(row) for row in models], self.regressor, team)
                whole = start if k == self.iterations else evaluated
                learned = StageResult(whole.whole(own), own, sets)
            yield Iteration(
                stage,
                stage.before + k,
                functools.partial(_state, k, sets, residual, failed),
                k == self.iterations,
                learned,
                [values[d.probe] for values, d in zip(q, sets, strict=True)],
                [values[d.probe] for values, d in zip(residual, sets, strict=True)],
                failed=failed,
            )

    def _data(
        self, stage: Stage, start: StageInit, team: SeedBatch
    ) -> tuple[list[dataset.Dataset], None, dict[int, str]]:
        """Each seed's dataset of ε-greedy episodes, no ϱ yet, which seeds failed."""
        previous = start.previous
        if not self.new_data and previous is not None:
            return previous.data, None, {}
        if self.shared_data:
            rngs = [stream(0, "shared_data", stage.task)]
        else:
            rngs = [stream(seed, "data", stage.number) for seed in team.seeds]
        env, episodes = stage.env, self.episodes
        begin = np.stack([rollout.start_states(rng, env, episodes) for rng in rngs])
        u = np.stack([rollout.draws(rng, env, episodes) for rng in rngs])
        q = ZERO if previous is None else previous.q
        played = rollout.rollout(env, q, begin, u, self.epsilon)
        sets = [dataset.build(env, played, s, team.probe) for s in range(len(rngs))]
        if not self.shared_data:
            return sets, None, played.failed
        n = len(team.seeds)
        return (
            sets * n,
            None,
            {s: why for s in range(n) for why in played.failed.values()},
        )

    def _problems(
        self,
        stage: Stage,
        k: int,
        team: SeedBatch,
        rewards: Values,
        sets: list[dataset.Dataset],
        base: Values,
        residual: Values,
    ) -> dict[tuple[int, int], Problem]:
        """Iteration k's regressions by (seed, action); none for an untried action."""
        problems: dict[tuple[int, int], Problem] = {}
        for s, d in enumerate(sets):
            q = base[s] + residual[s]
            y = residual_target(
                rewards[s],
                d.absorbing,
                q[d.next_state],
                base[s][d.state, d.action],
                stage.env.gamma,
            )
            for a, part in enumerate(d.by_action):
                if len(part.rows):
                    path = () if self.fixed_trees else (stage.number, k, a)
                    problems[s, a] = Problem(
                        part.x,
                        y[part.rows],
                        part.multiplicity,
                        part.queries,
                        team.seeds[s],
                        path,
                    )
        return problems


def _state(
    k: int, sets: list[dataset.Dataset], residual: Values, failed: dict[int, str]
) -> tuple:
    """What FQI needs to go on after iteration k: no model, the next fits anew."""
    return k, sets, residual, failed
