"""FQI's folding: its regressor is fitted once more, to the whole sum."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bcrl.envs import is_finite
from bcrl.learning import Floats, Integers
from bcrl.learning.dataset import Dataset
from bcrl.learning.folding import Folded
from bcrl.learning.stage import SeedBatch, Stage
from bcrl.learning.transfer import StageResult
from bcrl.q.functions import Q, Values, query
from bcrl.q.linear import linear
from bcrl.q.regressors.base import Cell, Fitted, FittedQ, Problem, Regressor, fit_each

MOST = 5000  # states at which the change is measured
_ROUNDING = 1e-6  # share of Q's size: regressors may compute in float32

Refit = tuple[StageResult, list[Floats], Folded, dict[int, str]]


def refit(
    regressor: Regressor,
    fixed: bool,
    stage: Stage,
    batch: SeedBatch,
    result: StageResult,
    total: list[Floats],
    failed: Mapping[int, str],
) -> Refit:
    """The result with one approximator for Q, and its values (P, A) at all points.

    `total` are Q's; `fixed`: all fits have the same random numbers. Also returns how Q
    changed, half-way between the states of transitions, and why seeds failed. A table
    and linear models stay as they are.
    """
    n_actions, data = stage.env.n_actions, result.data
    if is_finite(stage.env):  # all states are points
        folded = Folded.of(result.residual, total, total)
        return StageResult(result.q, result.q, data), total, folded, {}
    q: Q | None = linear(result.q)
    lost: dict[int, str] = {}
    if q is None or not _is_same(q, data, total, n_actions):
        made, total, lost = _fitted(regressor, fixed, stage, batch, data, total, failed)
        q = made
    between = [_half_way(d) for d in data]
    (before, _), (after, _) = (query(x, between, n_actions) for x in (result.q, q))
    folded = Folded.of(result.residual, before, after)
    return StageResult(q, q, data), total, folded, lost


def _fitted(
    regressor: Regressor,
    fixed: bool,
    stage: Stage,
    batch: SeedBatch,
    data: Sequence[Dataset],
    total: Sequence[Floats],
    failed: Mapping[int, str],
) -> tuple[FittedQ, list[Floats], dict[int, str]]:
    """One model per seed and action, fitted to Q at all states, and its values.

    A state counts as often as the data have visited it. Where episodes end, no action
    is chosen, so the values there are not fitted.
    """
    n_actions, problems = stage.env.n_actions, dict[Cell, Problem]()
    split = dict[int, tuple[Integers, Integers]]()  # the points by seed
    for s, d in enumerate(data):
        if s not in failed:
            visits = np.bincount(d.state, d.multiplicity, len(d.points))
            rows, others = np.flatnonzero(visits), np.flatnonzero(visits == 0)
            split[s], x = (rows, others), d.points[rows]  # the same for all actions
            counts = visits[rows].astype(np.int64)
            for a in range(n_actions):
                own = (x, total[s][rows, a], counts, d.points[others])
                path = () if fixed else (stage.number, 0, a)  # fits count from 1
                problems[s, a] = Problem(*own, batch.seeds[s], path)
    fits, lost = fit_each(regressor, problems, True, batch.threads)
    models: list[list[Fitted | None]] = [[None] * n_actions for _ in data]
    after = [values.copy() for values in total]
    for (s, a), fit in fits.items():
        rows, others = split[s]
        after[s][rows, a], after[s][others, a] = fit.fitted, fit.queried
        models[s][a] = Fitted.of(problems[s, a], fit)
    q = FittedQ([tuple(row) for row in models], regressor, batch)
    return q, after, lost


def _is_same(q: Q, data: Sequence[Dataset], total: Values, n_actions: int) -> bool:
    """Whether q has the values `total` at all points, but for rounding."""
    found, _ = query(q, [d.points.astype(float) for d in data], n_actions)
    pairs: Any = zip(found, total, strict=True)
    sound = ((x, y) for x, y in pairs if np.isfinite(y).all())
    return all(abs(x - y).max() <= _ROUNDING * (1 + abs(y).max()) for x, y in sound)


def _half_way(data: Dataset) -> Floats:
    """States (n, d) in the middle of transitions, which no fit has seen."""
    every = -(-len(data.state) // MOST)
    ends = data.points[data.state[::every]], data.points[data.next_state[::every]]
    return np.mean(ends, 0, dtype=np.float64)
