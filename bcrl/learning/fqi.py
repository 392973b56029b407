"""Fitted Q-iteration, plain or boosted: every stage learns a residual on a base."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bcrl.common.seeding import stream
from bcrl.common.serialization import storable
from bcrl.envs import is_finite, is_simulated
from bcrl.learning import Floats, dataset, rollout
from bcrl.learning.bellman import residual_target, shaping
from bcrl.learning.dataset import Dataset
from bcrl.learning.line_search import Searched, search
from bcrl.learning.refit import refit
from bcrl.learning.stage import Pause, SeedBatch, Snapshot, Stage
from bcrl.learning.transfer import StageInit, StageResult
from bcrl.learning.transitions import Logged, transitions_of
from bcrl.q.functions import NOT_FINITE, ZERO, Q, Table, Values, query
from bcrl.q.regressors.base import Cell, Fitted, FittedQ, Problem, Regressor, fit_each
from bcrl.q.regressors.ours import ForestRegressor


@storable
@dataclass(frozen=True)
class FQIState:
    """What FQI needs to resume after an iteration; the models are fitted anew."""

    iteration: int
    data: list[Dataset]  # S datasets
    residual: list[Floats] | None  # S arrays (P, A): ϱ at all points
    failed: dict[int, str]  # seeds that cannot continue, by index, and why


@dataclass(frozen=True)
class Iteration(Snapshot):
    """The snapshot after one iteration."""

    probed_q: Values  # S arrays (n_probe, A): Q at the probed states
    probed_residual: Values  # S arrays (n_probe, A): ϱ there


@dataclass(frozen=True)
class FQI:
    """Fitted Q-iteration for many seeds at once (Ernst et al. 2005; paper, Eq. 5).

    Every iteration fits, for each seed and action, a new regressor to
    r + γ max_a' Q(s', a') − base(s, a). Constant terms are computed once per stage.
    """

    iterations: int
    episodes: int = 1000
    regressor: Regressor = ForestRegressor()  # noqa: RUF009 (it is frozen)
    epsilon: float = 1.0  # of the ε-greedy data collection with the previous Q
    new_data: bool = True  # False: learn from the previous stage's data again
    shared_data: bool = False  # [released] one dataset per task for all seeds
    fixed_trees: bool = False  # [released] the same randomness in every fit of a seed
    evaluate_every: int = 1  # iterations of the stage; its last is always evaluated
    #: Logged transitions of all seeds, or their file or Minari dataset; None: own data,
    #: collected as `episodes`, `epsilon`, `new_data` and `shared_data` say.
    dataset: Logged | None = None

    name: ClassVar[str] = "fqi"

    @property
    def length(self) -> int:
        """Iterations of a stage."""
        return self.iterations

    def learn(
        self, stage: Stage, start: StageInit, batch: SeedBatch, state: Any = None
    ) -> Iterator[Pause]:
        """Learn a stage, ϱ ← S(T(base + ϱ) − base); yields after each iteration."""
        env, n_actions = stage.env, stage.env.n_actions
        state = state or self.collect(stage, start, batch)
        data, failed = state.data, state.failed

        def at_points(q: Q) -> list[Floats]:  # S arrays (P, A)
            nonlocal failed
            values, lost = query(q, [d.points for d in data], n_actions)
            failed = lost | failed
            return values

        base = at_points(start.base)
        searched = self._scales(start, base, data, env.gamma)
        if searched is not None:
            start = start.rescaled(searched.alpha)
            for s in range(len(base)):
                if s not in failed:  # its base may be infinite
                    base[s] = searched.alpha[s] * base[s]
        same = start.potential is start.base
        value = base if same else at_points(start.potential)
        potential = [v.max(-1) for v in value]  # S arrays (P,)
        residual = state.residual or at_points(start.initial)
        reward = [  # S arrays (n,)
            d.reward + shaping(v[d.state], v[d.next_state], d.absorbing, env.gamma)
            for d, v in zip(data, potential, strict=True)
        ]
        models: list[list[Fitted | None]] = [[None] * n_actions for _ in data]
        if isinstance(start.initial, FittedQ):
            models = [list(row) for row in start.initial.models]
        # Q-values are not cached if noise makes every state new, nor in the Q-function
        # that the next stage uses as its base.
        noisy = env.step_noise or is_simulated(env)
        pointwise = getattr(self.regressor, "pointwise", False)
        cached = start.memoized() if pointwise and not noisy else start
        for k in range(state.iteration + 1, self.iterations + 1):
            problems: dict[Cell, Problem] = {}
            for s, d in enumerate(data):
                if s in failed:  # a failed seed keeps its last finite ϱ
                    continue
                next_q = (base[s] + residual[s])[d.next_state]  # (n, A)
                now = base[s][d.state, d.action]  # (n,)
                y = residual_target(reward[s], d.absorbing, next_q, now, env.gamma)
                for a, (rows, others) in enumerate(d.by_action):
                    path = () if self.fixed_trees else (stage.number, k, a)
                    x, counts = d.points[d.state[rows]], d.multiplicity[rows]
                    fitted = (x, y[rows], counts, d.points[others])
                    if len(rows):  # an action that was never tried has no model
                        problems[s, a] = Problem(*fitted, batch.seeds[s], path)
            keep = not is_finite(env)  # a table is not queried between its points
            fits, lost = fit_each(self.regressor, problems, keep, batch.threads)
            failed = lost | failed
            residual = [values.copy() for values in residual]
            for (s, a), fit in fits.items():
                rows, others = data[s].by_action[a]
                residual[s][data[s].state[rows], a] = fit.fitted
                residual[s][others, a] = fit.queried
                models[s][a] = Fitted.of(problems[s, a], fit)
            total = [b + r for b, r in zip(base, residual, strict=True)]
            if start.shape is not None:
                total = [q + v[:, None] for q, v in zip(total, potential, strict=True)]
            bad = [s for s, q in enumerate(total) if not np.isfinite(q).all()]
            failed = dict.fromkeys(bad, NOT_FINITE) | failed
            after, count = FQIState(k, data, residual, failed), stage.before + k
            if k % self.evaluate_every and k < self.iterations:
                yield Pause(stage, count, after)
                continue
            ends, folded = k == self.iterations, None
            if is_finite(env):
                result = StageResult(Table(total, env), Table(residual, env), data)
            else:
                own = FittedQ([tuple(row) for row in models], self.regressor, batch)
                last = start if ends else cached
                result = StageResult(last.total(own), own, data)
            if ends and start.base is not ZERO and stage.boost.folds(stage.number):
                known = (self.regressor, self.fixed_trees, stage, batch)
                result, total, folded, lost = refit(*known, result, total, failed)
                failed = lost | failed
            probed = (
                [values[d.probe] for values, d in zip(each, data, strict=True)]
                for each in (total, residual)
            )
            more = {"searched": searched, "folded": folded, "failed": failed}
            yield Iteration(stage, count, after, result, *probed, **more)

    def _scales(
        self,
        start: StageInit,
        base: Sequence[Floats],
        data: Sequence[Dataset],
        gamma: float,
    ) -> Searched | None:
        """The scales of S bases, whose values at all points are S arrays (P, A)."""
        if (alpha := start.alpha) == 1.0:
            return None
        if not isinstance(alpha, str):
            return Searched.fixed(alpha, len(data))
        found = []
        for d, q in zip(data, base, strict=True):
            known = d.reward, q[d.state, d.action], q[d.next_state], d.absorbing
            found.append(search(*known, gamma, d.multiplicity))
        return Searched.of(found)

    def collect(self, stage: Stage, start: StageInit, batch: SeedBatch) -> FQIState:
        """The state before the first iteration, with a dataset for each seed."""
        env, previous, n = stage.env, start.previous, len(batch.seeds)
        if self.dataset is not None:
            given = transitions_of(self.dataset, stage.own_task or stage.task, env)
            every = [dataset.of_logged(env, given, batch.probe)] * n
            return FQIState(0, every, None, {})
        if not self.new_data and previous is not None:
            return FQIState(0, previous.data, None, {})
        rngs = [stream(seed, "data", stage.number) for seed in batch.seeds]
        if self.shared_data:
            rngs = [stream(0, "shared_data", stage.task)]
        first, u = rollout.starts_and_draws(rngs, env, self.episodes)
        q = ZERO if previous is None else previous.q
        episodes = rollout.rollout(env, q, first, u, self.epsilon)
        data = [dataset.build(env, episodes, s, batch.probe) for s in range(len(rngs))]
        failed = episodes.failed
        if self.shared_data:
            data *= n
            failed = {s: why for s in range(n) for why in failed.values()}
        return FQIState(0, data, None, failed)
