"""Statistics over seeds: means, standard errors, bootstrap and score intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

RESAMPLES = 10_000
LEVEL = 0.95
BLOCK = 4_000_000  # resampled seeds that are held in memory at a time
SEED = 20_220_425  # every interval draws from its own generator, started from this
NORMAL_QUANTILE = 1.959963984540054  # Φ⁻¹(0.975), the two-sided 95 % point


class Interval(NamedTuple):
    """A closed interval; both ends are nan where the data allow none."""

    low: float
    high: float


def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over seeds, the leading axis: (S, …) → (…)."""
    return np.mean(values, axis=0)


def standard_error(values: NDArray[np.float64], ddof: int = 0) -> NDArray[np.float64]:
    """Standard error of the mean over seeds: (S, …) → (…), nan if S ≤ ddof.

    The paper's figures have ddof = 0, as its released evaluation; tables have 1.
    """
    if len(values) <= ddof:
        return np.full(values.shape[1:], math.nan)
    return np.std(values, axis=0, ddof=ddof) / math.sqrt(len(values))


def interquartile_mean(values: ArrayLike) -> float:
    """Mean of (S,) values without the lowest and the highest ⌊S/4⌋ of them."""
    ordered = np.sort(np.asarray(values, dtype=float))
    cut = len(ordered) // 4
    return float(ordered[cut : len(ordered) - cut].mean())


def row_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of every resample: (B, S) → (B,)."""
    return values.mean(axis=-1)


def row_deviation(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation (ddof = 0) of every resample: (B, S) → (B,)."""
    return values.std(axis=-1)


Statistic = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def _resampled(
    values: ArrayLike, statistic: Statistic, rng: np.random.Generator
) -> NDArray[np.float64]:
    """`statistic` of RESAMPLES draws with replacement from (S,) values, (B,)."""
    values = np.asarray(values, dtype=float)
    return np.concatenate([statistic(values[r]) for r in _rows(len(values), rng)])


def _rows(n: int, rng: np.random.Generator) -> Iterator[NDArray[np.int64]]:
    """RESAMPLES draws of n seeds' places, in blocks (B, n); blocks change no draw."""
    most = max(1, BLOCK // n)
    for begun in range(0, RESAMPLES, most):
        yield rng.integers(n, size=(min(most, RESAMPLES - begun), n))


def _percentiles(draws: NDArray[np.float64]) -> Interval:
    tail = (1.0 - LEVEL) / 2.0
    low, high = np.quantile(draws, [tail, 1.0 - tail])
    return Interval(float(low), float(high))


def _usable(*samples: ArrayLike) -> bool:
    """One seed says nothing about the spread, a non-finite value nothing at all."""
    return all(len(x) > 1 and np.isfinite(x).all() for x in map(np.asarray, samples))


def bootstrap(values: ArrayLike, statistic: Statistic = row_mean) -> Interval:
    """95 % percentile bootstrap interval of a statistic of (S,) independent seeds.

    nan for fewer than two seeds and for non-finite values (Efron and Tibshirani 1993,
    chapter 13).
    """
    if not _usable(values):
        return Interval(math.nan, math.nan)
    return _percentiles(_resampled(values, statistic, np.random.default_rng(SEED)))


def bootstrap_curves(
    values: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`bootstrap` of the mean at every point of (S, I) curves: both ends, (I,) each."""
    n = len(values)
    if n < 2:
        return np.full((2, values.shape[1]), math.nan)
    means = []
    for rows in _rows(n, np.random.default_rng(SEED)):
        places = rows + n * np.arange(len(rows))[:, None]
        counts = np.bincount(places.ravel(), minlength=rows.size).reshape(-1, n)
        means.append(counts @ values / n)
    tail = (1.0 - LEVEL) / 2.0
    low, high = np.quantile(np.concatenate(means), [tail, 1.0 - tail], axis=0)
    return low, high


def bootstrap_difference(
    first: ArrayLike, second: ArrayLike, statistic: Statistic = row_mean
) -> Interval:
    """95 % percentile bootstrap interval of statistic(first) − statistic(second).

    The samples (S1,) and (S2,) are resampled independently of each other: seeds are
    not paired across methods. For a difference within seeds call `bootstrap` on it.
    """
    if not _usable(first, second):
        return Interval(math.nan, math.nan)
    rng = np.random.default_rng(SEED)
    draws = _resampled(first, statistic, rng)
    return _percentiles(draws - _resampled(second, statistic, rng))


def share_interval(successes: int, n: int) -> Interval:
    """95 % Wilson score interval of a share.

    Used for shares of seeds, where the bootstrap of 0 of n has no width (Wilson 1927).
    """
    if n == 0:
        return Interval(math.nan, math.nan)
    z2 = NORMAL_QUANTILE**2
    share = successes / n
    centre = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = math.sqrt(z2 * (share * (1 - share) / n + z2 / (4 * n * n))) / (1 + z2 / n)
    return Interval(max(0.0, centre - half), min(1.0, centre + half))


def share_difference_interval(k1: int, n1: int, k2: int, n2: int) -> Interval:
    """95 % interval of k1/n1 − k2/n2 from two Wilson intervals (Newcombe 1998)."""
    if min(n1, n2) == 0:
        return Interval(math.nan, math.nan)
    p1, p2 = k1 / n1, k2 / n2
    (l1, u1), (l2, u2) = share_interval(k1, n1), share_interval(k2, n2)
    low = p1 - p2 - math.hypot(p1 - l1, u2 - p2)
    return Interval(low, p1 - p2 + math.hypot(u1 - p1, p2 - l2))
