"""The forest as a scikit-learn estimator."""

import math
import os
from numbers import Integral
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.ensemble import ExtraTreesRegressor
from sklearn.utils import check_random_state, validation
from sklearn.utils._param_validation import Interval

from bcrl.q.forest import forest

_theirs = ExtraTreesRegressor._parameter_constraints
_COUNT = [Interval(Integral, 1, None, closed="left")]


class ExtraTrees(RegressorMixin, BaseEstimator):
    """Extra-trees regression, `bcrl.q.forest` behind scikit-learn's interface.

    The parameters have the meaning and defaults that they have in
    `sklearn.ensemble.ExtraTreesRegressor` (max_features=None is its 1.0). Trees differ
    from its trees, but have the same distribution. Weights must be whole numbers: a row
    of weight 3 gives exactly the trees of three equal rows. Not supported: several
    outputs, missing values, sparse X, fractional `min_samples_*`, other criteria than
    the squared error, `max_leaf_nodes`, `min_impurity_decrease`, `ccp_alpha`,
    `min_weight_fraction_leaf`, `monotonic_cst`, `bootstrap`, `oob_score`,
    `max_samples`, `warm_start`, `verbose`, `estimators_`, `apply`, `decision_path`.

    Parameters
    ----------
    n_estimators : number of trees.
    max_depth : levels of splits that a tree may have; None is no limit.
    min_samples_split : fewest rows, weights counted, of a node that is split.
    min_samples_leaf : fewest rows, weights counted, on either side of a split.
    max_features : features tried per split, or their share, "sqrt", "log2", None (all).
    random_state : source of the trees' seeds; an integer gives each fit the same trees.
    n_jobs : threads; None is 1, −1 is one per core. Never changes a result.

    Attributes
    ----------
    forest_ : the fitted trees, a `Forest`.
    feature_importances_ : each feature's share of the variance that the splits remove.
    n_features_in_ : columns of X.
    """

    _parameter_constraints: ClassVar[dict[str, list]] = {
        "max_depth": _theirs["max_depth"],
        "max_features": _theirs["max_features"],
        "random_state": _theirs["random_state"],
        "n_estimators": _COUNT,
        "min_samples_split": _theirs["min_samples_split"][:1],  # no shares of the rows
        "min_samples_leaf": _COUNT,
        "n_jobs": [*_COUNT, Interval(Integral, None, -1, closed="right"), None],
    }
    forest_: forest.Forest

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

    def _threads(self) -> int:
        jobs = self.n_jobs or 1
        return jobs if jobs > 0 else max(1, (os.cpu_count() or 1) + 1 + jobs)

    def fit(
        self,
        X: ArrayLike,
        y: ArrayLike,
        sample_weight: ArrayLike | None = None,
        multiplicity: ArrayLike | None = None,
    ) -> "ExtraTrees":
        """Fit to X (n, d) and y (n,); a row counts `sample_weight` (n,) times.

        Weights are whole numbers of at least 0; `multiplicity` is another name for
        them. Raises ValueError for data or parameters that no forest can be fitted to.
        """
        self._validate_params()
        threads = self._threads()
        if sample_weight is not None and multiplicity is not None:
            raise ValueError("sample_weight and multiplicity are the same: give one")
        x: np.ndarray
        x, y = validation.validate_data(
            self, X, y, dtype=np.float32, order="C", y_numeric=True, multi_output=False
        )
        counts = _counts(x, sample_weight if multiplicity is None else multiplicity)
        used = counts > 0
        x, counts, target = x[used], counts[used], np.asarray(y, np.float64)[used]
        random = check_random_state(self.random_state)
        seeds = random.randint(0, 2**64, size=self.n_estimators, dtype=np.uint64)
        most: Any = self.max_features
        if isinstance(most, str):
            most = max(1, int(getattr(math, most)(x.shape[1])))
        elif most is not None and not isinstance(most, Integral):
            most = max(1, int(most * x.shape[1]))
        limits = self.min_samples_split, self.min_samples_leaf, most, self.max_depth
        parts = np.array_split(seeds, min(threads, len(seeds)))
        tasks = [forest.Regression(x, target, part, counts) for part in parts]
        fits = forest.fit_forests(tasks, forest.TreeSettings(*limits), threads=threads)
        self.forest_ = forest.join([fit.forest for fit in fits if fit.forest])
        self._data: tuple[np.ndarray, ...] = x, target, counts  # small beside the trees
        return self

    @property
    def feature_importances_(self) -> np.ndarray:
        """Each feature's share of the variance that the splits remove, (d,)."""
        validation.check_is_fitted(self)
        return forest.importances(self.forest_, *self._data)

    def predict(self, X: ArrayLike) -> np.ndarray:
        """Mean of the trees at X (n, d): (n,) float64."""
        validation.check_is_fitted(self)
        x: np.ndarray = validation.validate_data(
            self, X, dtype=np.float32, order="C", reset=False
        )
        threads = self._threads()
        parts = np.array_split(x, min(threads, len(x)))
        forests = [self.forest_] * len(parts)
        return np.concatenate(forest.predict_forests(forests, parts, threads=threads))


def _counts(X: np.ndarray, weights: ArrayLike | None) -> np.ndarray:
    """How often each row counts, (n,) int64; ValueError for other weights."""
    counts: np.ndarray = validation._check_sample_weight(weights, X, dtype=np.float64)
    wrong = (counts < 0) | (counts % 1 != 0)
    if wrong.any() or not 0 < counts.sum() < 2**40:
        raise ValueError(
            f"sample_weight (multiplicity)={counts[wrong] if wrong.any() else counts}: "
            "must be whole numbers of at least 0, and their sum from 1 to 2^40 − 1"
        )
    return counts.astype(np.int64)
