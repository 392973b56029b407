"""The forest as a scikit-learn estimator."""

from __future__ import annotations

import math
import os
from numbers import Integral, Real

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils import check_random_state
from sklearn.utils.validation import (
    _check_sample_weight,
    check_is_fitted,
    validate_data,
)

from bcrl.errors import BcrlError
from bcrl.q.forest.forest import (
    Forest,
    Regression,
    TreeSettings,
    fit_forests,
    importances,
    join,
    predict_forests,
)


class ExtraTrees(RegressorMixin, BaseEstimator):
    """Extra-trees regression, `bcrl.q.forest` behind scikit-learn's interface.

    It has the parameters below of `sklearn.ensemble.ExtraTreesRegressor`, with the same
    meaning and the same defaults (max_features=None is scikit-learn's 1.0). Its trees
    differ, but have the same distribution. Weights must be whole numbers: a row of
    weight 3 gives exactly the trees of three equal rows. Not supported: several
    outputs, missing values, sparse X, fractional `min_samples_*`, other criteria than
    the squared error, `max_leaf_nodes`, `min_impurity_decrease`, `ccp_alpha`,
    `min_weight_fraction_leaf`, `monotonic_cst`, `bootstrap`, `oob_score`,
    `max_samples`, `warm_start`, `verbose`, `estimators_`, `apply`, `decision_path`.

    Parameters
    ----------
    n_estimators : int, default 100
        Number of trees.
    max_depth : int or None, default None
        Levels of splits that a tree may have; None is no limit.
    min_samples_split : int, default 2
        Fewest rows, weights counted, that a node must have to be split.
    min_samples_leaf : int, default 1
        Fewest rows, weights counted, on either side of a split.
    max_features : int, float, "sqrt", "log2" or None, default None
        Features tried per split: so many, such a share of them in (0, 1], or all.
    random_state : int, RandomState or None, default None
        Where the trees' seeds come from. An integer gives the same trees at every fit.
    n_jobs : int or None, default None
        Threads; None is 1, −1 is one per core. Never changes a result.

    Attributes
    ----------
    forest_ : Forest
        The fitted trees.
    feature_importances_ : ndarray of shape (n_features_in_,)
        Each feature's share of the variance that the splits remove (impurity-based).
    n_features_in_ : int
        Columns of X.
    """

    def __init__(
        self,
        n_estimators: int = 100,
        *,
        max_depth: int | None = None,
        min_samples_split: int = 2,
        min_samples_leaf: int = 1,
        max_features: int | float | str | None = None,
        random_state: int | np.random.RandomState | None = None,
        n_jobs: int | None = None,
    ) -> None:
        self.n_estimators = n_estimators
        self.max_depth = max_depth
        self.min_samples_split = min_samples_split
        self.min_samples_leaf = min_samples_leaf
        self.max_features = max_features
        self.random_state = random_state
        self.n_jobs = n_jobs

    forest_: Forest

    def fit(
        self,
        X: ArrayLike,
        y: ArrayLike,
        sample_weight: ArrayLike | None = None,
        multiplicity: ArrayLike | None = None,
    ) -> ExtraTrees:
        """Fit to X (n, d) and y (n,); a row counts `sample_weight` (n,) times.

        Weights are whole numbers of at least 0; `multiplicity` is another name for
        them. Raises ValueError for data or parameters that no forest can be fitted to.
        """
        trees, threads = self.n_estimators, self._threads()
        if not isinstance(trees, Integral) or trees < 1:
            raise ValueError(f"n_estimators={trees}: must be an integer of at least 1")
        if sample_weight is not None and multiplicity is not None:
            raise ValueError("sample_weight and multiplicity are the same: give one")
        X, y = validate_data(
            self, X, y, dtype=np.float32, order="C", y_numeric=True, multi_output=False
        )
        counts = _counts(X, sample_weight if multiplicity is None else multiplicity)
        X, y = X[counts > 0], np.asarray(y, np.float64)[counts > 0]
        counts = counts[counts > 0]
        random = check_random_state(self.random_state)
        seeds = random.randint(0, 2**64, size=trees, dtype=np.uint64)
        most = _n_features(self.max_features, X.shape[1])
        limits = self.min_samples_split, self.min_samples_leaf, most, self.max_depth
        parts = np.array_split(seeds, min(threads, trees))
        tasks = [Regression(X, y, part, counts) for part in parts]
        try:
            fits = fit_forests(tasks, TreeSettings(*limits), threads=threads)
        except BcrlError as error:
            raise ValueError(str(error)) from None
        self.forest_ = join([fit.forest for fit in fits if fit.forest is not None])
        self._data: tuple[np.ndarray, ...] = X, y, counts  # small beside the trees
        return self

    @property
    def feature_importances_(self) -> np.ndarray:
        """Each feature's share of the variance that the splits remove, (d,)."""
        check_is_fitted(self)
        return importances(self.forest_, *self._data)

    def predict(self, X: ArrayLike) -> np.ndarray:
        """Mean of the trees at X (n, d): (n,) float64."""
        check_is_fitted(self)
        x: np.ndarray = validate_data(self, X, dtype=np.float32, order="C", reset=False)
        threads = self._threads()
        parts = np.array_split(x, min(threads, len(x)))
        forests = [self.forest_] * len(parts)
        return np.concatenate(predict_forests(forests, parts, threads=threads))

    def _threads(self) -> int:
        """How many threads `n_jobs` stands for; ValueError for 0 or no integer."""
        jobs, cores = self.n_jobs, os.cpu_count() or 1
        if jobs is None:
            return 1
        if not isinstance(jobs, Integral) or jobs == 0:
            raise ValueError(f"n_jobs={jobs}: must be a number of threads, −1 or None")
        return max(jobs if jobs > 0 else cores + 1 + jobs, 1)


def _n_features(most: int | float | str | None, d: int) -> int | None:
    """How many of d features are tried per split; ValueError for a bad `most`."""
    if most is None:
        return None
    if isinstance(most, str) and most in ("sqrt", "log2"):
        return max(1, int(getattr(math, most)(d)))
    if isinstance(most, Integral) and most >= 1 and not isinstance(most, bool):
        return int(most)
    if isinstance(most, Real) and not isinstance(most, Integral) and 0.0 < most <= 1.0:
        return max(1, int(most * d))
    why = "must be an integer of at least 1, a share in (0, 1], sqrt, log2 or None"
    raise ValueError(f"max_features={most!r}: {why}")


def _counts(X: np.ndarray, weights: ArrayLike | None) -> np.ndarray:
    """How often each row counts, (n,) int64; ValueError for other weights."""
    try:
        counts: np.ndarray = _check_sample_weight(weights, X, dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"sample_weight (multiplicity): {error}") from None
    wrong = np.flatnonzero((counts < 0) | (counts != np.floor(counts)))
    if len(wrong) or not counts.any():
        row = wrong[0] if len(wrong) else 0
        raise ValueError(
            f"sample_weight (multiplicity) of row {row} is {counts[row]}: must be a "
            "whole number of at least 0, and not all may be 0; a row counts so often"
        )
    if counts.sum() >= 2**40:
        raise ValueError("sample_weight (multiplicity): the sum must stay below 2^40")
    return counts.astype(np.int64)
