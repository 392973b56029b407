"""The regressors of fitted Q-iteration that can be chosen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bcrl.common import plugins
from bcrl.errors import ConfigError, at_least, did_you_mean
from bcrl.q.forest import forest
from bcrl.q.regressors.base import Fit, Problem
from bcrl.q.regressors.scikit import Sklearn, SklearnForest


@dataclass(frozen=True)
class ForestRegressor:
    """Extremely randomised trees, compiled (Geurts et al. 2006; Ernst et al. 2005)."""

    trees: int = 50
    min_samples_split: int = 5
    min_samples_leaf: int = 2
    finite_only = False
    pointwise = True

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
class Tabular:
    """The exact regressor: the mean target of each point, 0 where none was seen."""

    finite_only = True

    def fit(self, problems: Sequence[Problem], keep: bool, threads: int) -> list[Fit]:
        return [self._fit_one(p) for p in problems]

    def _fit_one(self, problem: Problem) -> Fit:
        _, cell = np.unique(problem.x, axis=0, return_inverse=True)
        cell = cell.reshape(-1)  # NumPy 2.0 gives (n, 1)
        weight = np.bincount(cell, problem.multiplicity)
        mean = np.bincount(cell, problem.multiplicity * problem.y) / weight
        return Fit(None, mean[cell], np.zeros(len(problem.queries)))

    def predict(
        self, models: Sequence[Any], x: Sequence[NDArray], threads: int
    ) -> list[NDArray[np.float64]]:
        raise NotImplementedError("a table is only asked at its own points")


REGRESSORS = {
    "forest": ForestRegressor,
    "sklearn": Sklearn,
    "sklearn_forest": SklearnForest,
    "tabular": Tabular,
}


def regressor_class(name: str) -> type:
    """The regressor class called `name` in `algorithm.regressor.name`.

    A name with a dot, `package.module.Class`, is the user's own, as BCRL_TRUST allows.
    """
    if "." in name:
        return plugins.component("algorithm.regressor.name", name, name)
    if name not in REGRESSORS:
        raise ConfigError(
            "algorithm.regressor.name", name, did_you_mean(name, REGRESSORS)
        )
    return REGRESSORS[name]
