"""Fitted Q-iteration, plain or boosted: every stage learns a residual on a base."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bcrl import data, rollout
from bcrl.bellman import residual_target
from bcrl.envs import Env, is_finite
from bcrl.q import ZERO, Fits, Q, Table, Values, add
from bcrl.q.regressors import Fit, Problem, Regressor
from bcrl.streams import stream
from bcrl.transfer import Transfer


@dataclass(frozen=True)
class Stage:
    """One slot of a run: the task to learn, for how long, from which data."""

    number: int  # slot, from 1
    task: int  # position in the environment's task sequence, from 1
    env: Env
    iterations: int
    episodes: int
    epsilon: float  # the data's exploration, ε-greedy on the Q learned so far
    new_data: bool  # else the previous stage's data are learned from again


@dataclass(frozen=True)
class Snapshot:
    """What FQI knows after one iteration, for S seeds."""

    stage: Stage
    iteration: int  # from 1, over the whole run
    last_of_stage: bool
    q: Q
    probed_q: Values  # S arrays (n_probe, A): Q at the probed states
    probed_residual: Values  # S arrays (n_probe, A): ϱ there


@dataclass
class FQI:
    """Fitted Q-iteration for many seeds at once (Ernst et al. 2005; paper, Eq. 5).

    One iteration refits, for every seed and action, a regressor from scratch to
    `r + γ max_a' Q(s', a') − base(s, a)`. What a stage keeps fixed is computed once:
    its distinct points, which rows belong to which action, the base's values there.
    """

    seeds: Sequence[int]
    regressor: Regressor
    transfer: Transfer
    shared_data: bool = False  # [released] one dataset a task for all seeds
    fixed_trees: bool = False  # [released] the same randomness in every fit of a seed
    threads: int = 1
    _datasets: list[data.Dataset] = field(default_factory=list)

    def run(
        self, stages: Sequence[Stage], probe: NDArray[np.float64]
    ) -> Iterator[Snapshot]:
        """Learn the stages in order, yielding after each iteration.

        `probe` (n_probe, d) are the states whose values each snapshot carries.
        """
        q: Q = ZERO
        done = 0
        for stage in stages:
            if stage.new_data:
                self._datasets = self._collect(stage, q, probe)
            for snapshot in self._learn(stage, q, done):
                yield snapshot
            q, done = snapshot.q, done + stage.iterations

    def _collect(self, stage: Stage, q: Q, probe: NDArray) -> list[data.Dataset]:
        """Each seed's dataset of ε-greedy episodes in the stage's task."""
        if self.shared_data:
            rngs = [stream(0, "shared_data", stage.task)]
        else:
            rngs = [stream(seed, "data", stage.number) for seed in self.seeds]
        env, episodes = stage.env, stage.episodes
        start = np.stack([rollout.start_states(rng, env, episodes) for rng in rngs])
        u = np.stack([rollout.draws(rng, env, episodes) for rng in rngs])
        played = rollout.rollout(env, q, start, u, stage.epsilon)
        sets = [data.build(env, played, s, probe) for s in range(len(rngs))]
        return sets * len(self.seeds) if self.shared_data else sets

    def _learn(self, stage: Stage, previous: Q, done: int) -> Iterator[Snapshot]:
        """One stage: with (base, ϱ) from the transfer, ϱ ← S(T(base + ϱ) − base)."""
        env, sets = stage.env, self._datasets
        start = self.transfer(previous)
        points = [d.points for d in sets]
        base = start.base(points, env.n_actions)
        residual = start.initial(points, env.n_actions)
        models = (
            [list(row) for row in start.initial.models]
            if isinstance(start.initial, Fits)
            else [[None] * env.n_actions for _ in sets]
        )
        for k in range(1, stage.iterations + 1):
            residual = [values.copy() for values in residual]
            fits = self._fit(stage, k, base, residual)
            for (s, a), fit in fits.items():
                part = sets[s].by_action[a]
                residual[s][sets[s].state[part.rows], a] = fit.fitted
                residual[s][part.query_points, a] = fit.queried
                models[s][a] = fit.model
            q = [b + r for b, r in zip(base, residual, strict=True)]
            yield Snapshot(
                stage,
                done + k,
                k == stage.iterations,
                Table(q, env.index)
                if is_finite(env)
                else add(
                    start.base, Fits([tuple(row) for row in models], self._predict)
                ),
                [values[d.probe] for values, d in zip(q, sets, strict=True)],
                [values[d.probe] for values, d in zip(residual, sets, strict=True)],
            )

    def _fit(
        self, stage: Stage, k: int, base: Values, residual: Values
    ) -> dict[tuple[int, int], Fit]:
        """Iteration k's fits by (seed, action); an action never tried has none."""
        problems: dict[tuple[int, int], Problem] = {}
        for s, d in enumerate(self._datasets):
            q = base[s] + residual[s]
            y = residual_target(
                d.reward,
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
                        stream(self.seeds[s], "trees", *path),
                    )
        keep = not is_finite(stage.env)  # a table is never asked between its points
        fits = self.regressor.fit(list(problems.values()), keep, self.threads)
        return dict(zip(problems, fits, strict=True))

    def _predict(self, models: list, x: list[NDArray]) -> list[NDArray[np.float64]]:
        return self.regressor.predict(models, x, self.threads)
