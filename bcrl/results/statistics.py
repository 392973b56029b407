"""Statistics over seeds: standard errors, bootstrap and score intervals."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

_RESAMPLES = 10_000
LEVEL = 0.95
MOST_DRAWS = 4_000_000  # resampled seeds that are held in memory at a time
_SEED = 20_220_425  # every interval draws from its own generator, started from this
FEWEST_SEEDS = 5  # for a verdict: the bootstrap of fewer is far too narrow
Interval = tuple[float, float]  # closed; both ends are nan where the data allow none


def standard_error(values: np.ndarray) -> np.ndarray:
    """Standard error (ddof = 1) of the mean over seeds: (S, …) → (…), nan if S = 1."""
    if len(values) < 2:
        return np.full(values.shape[1:], math.nan)
    return np.std(values, axis=0, ddof=1) / math.sqrt(len(values))


def bootstrap(
    *samples: ArrayLike, statistic: Callable[..., np.ndarray] = np.mean
) -> Interval:
    """95 % percentile bootstrap interval of a statistic of (S,) seeds or of two groups'
    difference, resampled independently: seeds aren't paired across methods. nan for one
    seed and non-finite values (Efron and Tibshirani 1993, chapter 13)."""
    given = [np.asarray(sample, float) for sample in samples]
    if not all(len(sample) > 1 and np.isfinite(sample).all() for sample in given):
        return math.nan, math.nan

    def of(*drawn: np.ndarray, axis: int) -> np.ndarray:
        first, *rest = (statistic(each, axis=axis) for each in drawn)
        return first - rest[0] if rest else first

    options = {"confidence_level": LEVEL, "method": "percentile", "vectorized": True}
    options["batch"] = max(1, MOST_DRAWS // max(map(len, given)))
    options |= {"n_resamples": _RESAMPLES, "rng": np.random.default_rng(_SEED)}
    low, high = stats.bootstrap(given, of, **options).confidence_interval
    return float(low), float(high)


def bootstrap_curves(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`bootstrap` of the mean at every point of (S, I) curves: both ends, (I,) each.
    One draw of the seeds serves all points: four times as fast as SciPy's."""
    n = len(values)
    if n < 2:
        nothing = np.full(values.shape[1], math.nan)
        return nothing, nothing
    rng, means, most = np.random.default_rng(_SEED), [], max(1, MOST_DRAWS // n)
    for begun in range(0, _RESAMPLES, most):
        rows = rng.integers(n, size=(min(most, _RESAMPLES - begun), n))
        places = rows + n * np.arange(len(rows))[:, None]
        counts = np.bincount(places.ravel(), minlength=rows.size).reshape(-1, n)
        means.append(counts @ values / n)
    tail = (1.0 - LEVEL) / 2.0
    low, high = np.quantile(np.concatenate(means), [tail, 1.0 - tail], axis=0)
    return low, high


def share_interval(successes: int, n: int) -> Interval:
    """95 % score interval of a share (Wilson 1927); a bootstrap of 0 has no width."""
    found = stats.binomtest(successes, n).proportion_ci(LEVEL, method="wilson")
    return float(found.low), float(found.high)


def share_difference_interval(k1: int, n1: int, k2: int, n2: int) -> Interval:
    """95 % interval of k1/n1 − k2/n2 from two Wilson intervals (Newcombe 1998)."""
    p1, p2 = k1 / n1, k2 / n2
    (l1, u1), (l2, u2) = share_interval(k1, n1), share_interval(k2, n2)
    low = p1 - p2 - math.hypot(p1 - l1, u2 - p2)
    return low, p1 - p2 + math.hypot(u1 - p1, p2 - l2)
