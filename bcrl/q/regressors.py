"""Regressors for fitted Q-iteration: the protocol, and the ones that can be chosen."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bcrl import trust
from bcrl.errors import ConfigError, at_least, did_you_mean
from bcrl.pack import DERIVED, storable
from bcrl.q import Values, forest
from bcrl.streams import stream


@storable
@dataclass(frozen=True)
class Problem:
    """One regression (one seed and action), with the points its fit is asked at.

    A fit depends on nothing else, so that a problem can be stored in a model's place.
    """

    x: NDArray[np.float32]  # (n, d)
    y: NDArray[np.float64]  # (n,)
    multiplicity: NDArray[np.int64]  # (n,) how many rows each row stands for
    queries: NDArray[np.float32]  # (m, d)
    seed: int
    path: tuple[int, ...]  # of the seed's stream "trees"

    @property
    def rng(self) -> np.random.Generator:
        """The fit's own randomness, from its beginning."""
        return stream(self.seed, "trees", *self.path)


@dataclass(frozen=True)
class Fit:
    """A fitted model and its predictions at the rows (n,) and the queries (m,)."""

    model: Any
    fitted: NDArray[np.float64]
    queried: NDArray[np.float64]


class Regressor(Protocol):
    """Fits many problems at once; constructor arguments are its YAML keys.

    `finite_only`: whether it needs an environment with finitely many states.
    """

    finite_only: bool

    def fit(self, problems: Sequence[Problem], keep: bool, threads: int) -> list[Fit]:
        """Fits, in order; `keep=False` says that no model will be asked again."""

    def predict(
        self, models: Sequence[Any], x: Sequence[NDArray], threads: int
    ) -> list[NDArray[np.float64]]:
        """Each model's predictions (n,) at its own points (n, d)."""


@dataclass(frozen=True)
class ForestRegressor:
    """Extremely randomised trees, compiled (Geurts et al. 2006; Ernst et al. 2005)."""

    trees: int = 50
    min_samples_split: int = 5
    min_samples_leaf: int = 2
    finite_only = False

    def __post_init__(self) -> None:
        at_least("algorithm.regressor.trees", self.trees, 1)
        at_least("algorithm.regressor.min_samples_split", self.min_samples_split, 2)
        at_least("algorithm.regressor.min_samples_leaf", self.min_samples_leaf, 1)

    def fit(self, problems: Sequence[Problem], keep: bool, threads: int) -> list[Fit]:
        settings = forest.TreeSettings(self.min_samples_split, self.min_samples_leaf)
        jobs = [
            forest.Regression(
                p.x,
                p.y,
                p.rng.integers(2**64, size=self.trees, dtype=np.uint64),
                None if (p.multiplicity == 1).all() else p.multiplicity,
                p.queries,
            )
            for p in problems
        ]
        fits = forest.fit_forests(jobs, settings, threads=threads, keep=keep)
        return [Fit(f.forest, f.fitted, f.queried) for f in fits]

    def predict(
        self, models: Sequence[Any], x: Sequence[NDArray], threads: int
    ) -> list[NDArray[np.float64]]:
        return forest.predict_forests(models, x, threads=threads)


@dataclass(frozen=True)
class SklearnForestRegressor(ForestRegressor):
    """scikit-learn's own forest; multiplicities become repeated rows."""

    def fit(self, problems: Sequence[Problem], keep: bool, threads: int) -> list[Fit]:
        seeds = [int(p.rng.integers(2**31)) for p in problems]
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(self._fit_one, problems, seeds))

    def _fit_one(self, problem: Problem, seed: int) -> Fit:
        from sklearn.ensemble import ExtraTreesRegressor

        model = ExtraTreesRegressor(
            n_estimators=self.trees,
            min_samples_split=self.min_samples_split,
            min_samples_leaf=self.min_samples_leaf,
            random_state=seed,
        )
        repeat = np.repeat(np.arange(len(problem.y)), problem.multiplicity)
        model.fit(problem.x[repeat], problem.y[repeat])
        both = model.predict(np.concatenate([problem.x, problem.queries]))
        return Fit(model, *np.split(both, [len(problem.y)]))

    def predict(
        self, models: Sequence[Any], x: Sequence[NDArray], threads: int
    ) -> list[NDArray[np.float64]]:
        return [m.predict(p) for m, p in zip(models, x, strict=True)]


@dataclass(frozen=True)
class Tabular:
    """The exact regressor: the mean target of each point, 0 where none was seen."""

    finite_only = True

    def fit(self, problems: Sequence[Problem], keep: bool, threads: int) -> list[Fit]:
        return [self._fit_one(p) for p in problems]

    def _fit_one(self, problem: Problem) -> Fit:
        _, cell = np.unique(problem.x, axis=0, return_inverse=True)
        weight = np.bincount(cell, problem.multiplicity)
        mean = np.bincount(cell, problem.multiplicity * problem.y) / weight
        return Fit(None, mean[cell], np.zeros(len(problem.queries)))

    def predict(
        self, models: Sequence[Any], x: Sequence[NDArray], threads: int
    ) -> list[NDArray[np.float64]]:
        raise NotImplementedError("a table is only asked at its own points")


@storable
@dataclass
class Fitted:
    """A model and what it was fitted to, from which it can be had again."""

    problem: Problem  # without its queries
    model: Any = field(default=None, metadata=DERIVED)

    @classmethod
    def of(cls, problem: Problem, fit: Fit) -> Fitted:
        """The model of a fit, for as long as it may be asked."""
        return cls(replace(problem, queries=problem.queries[:0]), fit.model)


class Threads(Protocol):
    """Whoever says how many threads predictions may take."""

    threads: int


@storable
@dataclass(frozen=True)
class Fits:
    """Q as one model per seed and action; an action never seen predicts 0 (None)."""

    models: Sequence[Sequence[Fitted | None]]
    regressor: Regressor
    team: Threads

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        self._restore()
        cells = [
            (s, a)
            for s, row in enumerate(self.models)
            for a, fitted in enumerate(row)
            if fitted is not None and len(states[s])
        ]
        out = [np.zeros((len(x), n_actions)) for x in states]
        found = self.regressor.predict(
            [self.models[s][a].model for s, a in cells],
            [states[s] for s, _ in cells],
            self.team.threads,
        )
        for (s, a), values in zip(cells, found, strict=True):
            out[s][:, a] = values
        return np.stack(out) if isinstance(states, np.ndarray) else out

    def _restore(self) -> None:
        """Fit once more what came out of a checkpoint without its model."""
        lost = [f for row in self.models for f in row if f and f.model is None]
        if lost:
            problems = [fitted.problem for fitted in lost]
            fits = self.regressor.fit(problems, True, self.team.threads)
            for fitted, fit in zip(lost, fits, strict=True):
                fitted.model = fit.model


REGRESSORS = {
    "forest": ForestRegressor,
    "sklearn_forest": SklearnForestRegressor,
    "tabular": Tabular,
}


def regressor_class(name: str) -> type:
    """The regressor class called `name` in `algorithm.regressor.name`.

    A name with a dot, `package.module.Class`, is the user's own, as BCRL_TRUST allows.
    """
    if "." in name:
        return trust.component("algorithm.regressor.name", name, name)
    if name not in REGRESSORS:
        raise ConfigError(
            "algorithm.regressor.name", name, did_you_mean(name, REGRESSORS)
        )
    return REGRESSORS[name]
