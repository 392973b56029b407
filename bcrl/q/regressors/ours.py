"""Our own regressors, and all regressors of fitted Q-iteration by name."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bcrl.common import plugins
from bcrl.common.checks import one_of
from bcrl.q.forest import forest
from bcrl.q.regressors.base import Fit, Problem
from bcrl.q.regressors.scikit import Sklearn, SklearnForest, TreeKeys


@dataclass(frozen=True)
class ForestRegressor(TreeKeys):
    """Extremely randomised trees, compiled (Geurts et al. 2006; Ernst et al. 2005)."""

    finite_only = False
    pointwise = True

    def fit(self, problems: Sequence[Problem], keep: bool, threads: int) -> list[Fit]:
        settings = forest.TreeSettings(self.min_samples_split, self.min_samples_leaf)
        tasks = []
        for p in problems:
            seeds = p.rng.integers(2**64, size=self.trees, dtype=np.uint64)
            counts = None if (p.multiplicity == 1).all() else p.multiplicity
            tasks.append(forest.Regression(p.x, p.y, seeds, counts, p.queries))
        fits = forest.fit_forests(tasks, settings, threads=threads, keep=keep)
        return [Fit(f.forest, f.fitted, f.queried) for f in fits]

    def predict(
        self, models: Sequence[Any], x: Sequence[NDArray], threads: int
    ) -> list[NDArray[np.float64]]:
        return forest.predict_forests(models, x, threads=threads)


@dataclass(frozen=True)
class Tabular:
    """The exact regressor: the mean target of each point, and 0 at unseen points."""

    finite_only = True

    def fit(self, problems: Sequence[Problem], keep: bool, threads: int) -> list[Fit]:
        fits = []
        for p in problems:
            _, cell = np.unique(p.x, axis=0, return_inverse=True)
            cell = cell.reshape(-1)  # NumPy 2.0 gives (n, 1)
            weight = np.bincount(cell, p.multiplicity)
            mean = np.bincount(cell, p.multiplicity * p.y) / weight
            fits.append(Fit(None, mean[cell], np.zeros(len(p.queries))))
        return fits

    def predict(
        self, models: Sequence[Any], x: Sequence[NDArray], threads: int
    ) -> list[NDArray[np.float64]]:
        raise NotImplementedError("a table has values at its own points only")


REGRESSORS = {
    "forest": ForestRegressor,
    "sklearn": Sklearn,
    "sklearn_forest": SklearnForest,
    "tabular": Tabular,
}


def regressor_class(name: str) -> type:
    """The class for `algorithm.regressor.name`; a name with dots is a user's class."""
    key = "algorithm.regressor.name"
    if "." in name:
        return plugins.component(key, name, name)
    one_of(key, name, REGRESSORS)
    return REGRESSORS[name]
