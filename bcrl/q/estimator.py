"""The forest as a scikit-learn estimator."""

from __future__ import annotations

import os
from numbers import Integral

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_array, check_is_fitted, validate_data

from bcrl.errors import BcrlError
from bcrl.q.forest import (
    Forest,
    Regression,
    TreeSettings,
    fit_forests,
    join,
    predict_forests,
)


class ExtraTrees(RegressorMixin, BaseEstimator):
    """Extra-trees regression, `bcrl.q.forest` behind scikit-learn's interface.

    Parameters
    ----------
    n_estimators : int, default 100
        Number of trees.
    min_samples_split : int, default 2
        Fewest rows, multiplicities counted, that a node must have to be split.
    min_samples_leaf : int, default 1
        Fewest rows, multiplicities counted, on either side of a split.
    max_features : int or None, default None
        Features tried per split; None tries all.
    random_state : int, RandomState or None, default None
        Where the trees' seeds come from. An integer gives the same trees at every fit.
    n_jobs : int or None, default None
        Threads; None is 1, −1 is one per core. Never changes a result.

    Attributes
    ----------
    forest_ : Forest
        The fitted trees.
    n_features_in_ : int
        Columns of X.
    """

    def __init__(
        self,
        n_estimators: int = 100,
        *,
        min_samples_split: int = 2,
        min_samples_leaf: int = 1,
        max_features: int | None = None,
        random_state: int | np.random.RandomState | None = None,
        n_jobs: int | None = None,
    ) -> None:
        self.n_estimators = n_estimators
        self.min_samples_split = min_samples_split
        self.min_samples_leaf = min_samples_leaf
        self.max_features = max_features
        self.random_state = random_state
        self.n_jobs = n_jobs

    forest_: Forest

    def fit(
        self, X: np.ndarray, y: np.ndarray, multiplicity: np.ndarray | None = None
    ) -> ExtraTrees:
        """Fit to X (n, d) and y (n,); a row counts `multiplicity` (n,) times.

        Raises ValueError for data or parameters that no forest can be fitted to.
        """
        if not isinstance(self.n_estimators, Integral) or self.n_estimators < 1:
            raise ValueError(f"n_estimators={self.n_estimators}: must be at least 1")
        X, y = validate_data(
            self, X, y, dtype=np.float32, order="C", y_numeric=True, multi_output=False
        )
        if multiplicity is not None:
            multiplicity = check_array(
                multiplicity, ensure_2d=False, dtype=np.int64, input_name="multiplicity"
            )
        random = check_random_state(self.random_state)
        seeds = random.randint(0, 2**64, size=self.n_estimators, dtype=np.uint64)
        settings = TreeSettings(
            self.min_samples_split, self.min_samples_leaf, self.max_features
        )
        y, threads = np.asarray(y, np.float64), self._threads()
        parts = [
            Regression(X, y, part, multiplicity)
            for part in np.array_split(seeds, min(threads, self.n_estimators))
        ]
        try:
            fits = fit_forests(parts, settings, threads=threads)
        except BcrlError as error:
            raise ValueError(str(error)) from None
        self.forest_ = join([fit.forest for fit in fits])
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Mean of the trees at X (n, d): (n,) float64."""
        check_is_fitted(self)
        X = validate_data(self, X, dtype=np.float32, order="C", reset=False)
        parts = np.array_split(X, min(self._threads(), len(X)))
        forests = [self.forest_] * len(parts)
        return np.concatenate(predict_forests(forests, parts, threads=self._threads()))

    def _threads(self) -> int:
        """How many threads `n_jobs` stands for."""
        jobs, cores = self.n_jobs, os.cpu_count() or 1
        return 1 if jobs is None else max(jobs if jobs > 0 else cores + 1 + jobs, 1)
