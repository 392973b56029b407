"""Extra-trees regression for many small problems at once, with scikit-learn's meaning.

Geurts, Ernst and Wehenkel, "Extremely randomized trees", Machine Learning 63 (2006):
each tree sees all rows; in a node one threshold is drawn per tried feature, uniformly
between the feature's extremes, and the one that reduces the variance most is kept.
Beyond scikit-learn: a row of multiplicity k counts as k equal rows; rows and queries
are predicted while the trees grow; many forests are fitted in one call, on threads.
Targets are rounded to multiples of about max|y| · rows · 2^−62; sums are then exact.
"""

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass
from functools import cache
from itertools import pairwise

import numpy as np

from bcrl.errors import BcrlError, at_least

_pool = cache(ThreadPoolExecutor)  # starting threads costs more than a small call


@dataclass(frozen=True)
class TreeSettings:
    """scikit-learn's parameters of the same names; None is no limit."""

    min_samples_split: int = 2
    min_samples_leaf: int = 1
    max_features: int | None = None
    max_depth: int | None = None

    def __post_init__(self) -> None:
        at_least("min_samples_split", self.min_samples_split, 2)
        for name in ("min_samples_leaf", "max_features", "max_depth"):
            at_least(name, getattr(self, name), 1)


@dataclass
class Regression:
    """One forest's problem; BcrlError for data that no forest can be fitted to."""

    x: np.ndarray  # (n, d) float32, finite, as all values
    y: np.ndarray  # (n,) float64
    tree_seeds: np.ndarray  # (T,) uint64, one per tree
    multiplicity: np.ndarray | None = None  # (n,) int64 from 1 on; None: all are 1
    queries: np.ndarray | None = None  # (m, d) float32

    def __post_init__(self) -> None:
        x = self.x = _points("x", self.x)
        y = self.y = np.ascontiguousarray(self.y, np.float64)
        seeds = self.tree_seeds = np.ascontiguousarray(self.tree_seeds, np.uint64)
        if len(x) < 1 or y.shape != (len(x),):
            raise BcrlError(f"y has shape {y.shape}, expected ({max(len(x), 1)},)")
        if not np.isfinite(y).all():
            raise BcrlError("y holds NaN or infinity")
        if seeds.ndim != 1 or len(seeds) < 1:
            raise BcrlError(f"tree_seeds has shape {seeds.shape}, expected (trees,)")
        given, self.multiplicity = self.multiplicity, np.empty(0, np.int64)
        if given is not None:
            counts = self.multiplicity = np.ascontiguousarray(given, np.int64)
            if counts.shape != y.shape or counts.min() < 1 or counts.sum() >= 2**40:
                why = "integers of at least 1, below 2^40 in all"
                raise BcrlError(f"multiplicity must be ({len(x)},) {why}")
        given = x[:0] if self.queries is None else self.queries
        self.queries = _points("queries", given, x.shape[1])
        most = 2 ** (32 - (x.shape[1] - 1).bit_length()) - 1
        if len(self.queries) > most:
            raise BcrlError(
                f"queries has {len(given)} rows, at most {most} are allowed"
            )


@dataclass(frozen=True)
class Forest:
    """The trees of a forest, packed one after the other: 16 bytes per node."""

    nodes: np.ndarray  # (N,) of `split.NODE`
    values: np.ndarray  # (leaves,) float64
    first: np.ndarray  # (T+1,) int64, where each tree begins
    depths: np.ndarray  # (T,) int64, 0 for a tree that is a single leaf
    n_features: int

    def predict(self, x: np.ndarray) -> np.ndarray:
        """Mean of the trees at `x`, (n, d) taken as float32: (n,) float64."""
        return predict_forests([self], [x])[0]


@dataclass
class ForestFit:
    """A fitted forest, and what its `predict` gives at the rows and at the queries."""

    forest: Forest | None  # if it was kept
    fitted: np.ndarray  # (n,) float64
    queried: np.ndarray  # (m,) float64


def join(forests: Sequence[Forest]) -> Forest:
    """One forest of all the trees of `forests`, in order."""
    nodes = np.concatenate([forest.nodes for forest in forests])
    first, at, leaves = [np.zeros(1, np.int64)], 0, 0
    for forest in forests:
        part = nodes[at : at + len(forest.nodes)]
        part["child"] += np.where(part["feature"] < 0, leaves, at).astype(np.int32)
        first.append(forest.first[1:] + at)
        at, leaves = at + len(part), leaves + len(forest.values)
    values = np.concatenate([forest.values for forest in forests])
    depths = np.concatenate([forest.depths for forest in forests])
    return Forest(nodes, values, np.concatenate(first), depths, forests[0].n_features)


def importances(
    forest: Forest, x: np.ndarray, y: np.ndarray, multiplicity: np.ndarray
) -> np.ndarray:
    """The trees' mean shares (d,) of the variance that each feature's splits remove.

    Zeros without splits, as in scikit-learn (Breiman et al. 1984). x (n, d) float32,
    y (n,), multiplicity (n,): what the forest was fitted to.
    """
    bits = (x + np.float32(0.0)).view(np.int32)  # −0 is taken as +0
    keys = bits ^ ((bits >> 31) & np.int32(2**31 - 1))  # `split.key_of`
    y = y - np.average(y, weights=multiplicity)
    moments = multiplicity * np.stack([np.ones(len(y)), y, y * y])
    shares = np.zeros((len(forest.depths), x.shape[1]))
    for share, (root, end) in zip(shares, pairwise(forest.first), strict=True):
        nodes = forest.nodes[root:end]
        sums = np.zeros((3, len(nodes)))  # of each node's rows: weight, y and y²
        rows, at = np.arange(len(x)), np.zeros(len(x), np.intp)
        while len(rows):  # each turn is a level of the tree
            for total, moment in zip(sums, moments, strict=True):
                total += np.bincount(at, moment[rows], len(nodes))
            inner = nodes["feature"][at] >= 0
            rows, node = rows[inner], nodes[at[inner]]
            at = node["child"] - root + (keys[rows, node["feature"]] > node["cut"])
        weight, first, second = sums
        spread = second - first**2 / weight
        split = np.flatnonzero(nodes["feature"] >= 0)
        left = nodes["child"][split] - root
        taken = spread[split] - spread[left] - spread[left + 1]
        np.add.at(share, nodes["feature"][split], np.maximum(taken, 0.0))
    whole = shares.sum(1, keepdims=True)
    shares = (shares / np.where(whole > 0.0, whole, 1.0)).sum(0)
    return shares / max(shares.sum(), 1e-300)


def fit_forests(
    regressions: Sequence[Regression],
    settings: TreeSettings,
    *,
    threads: int = 1,
    keep: bool = True,
) -> list[ForestFit]:
    """Fit one forest per regression; neither `threads` nor the others change it.

    keep: whether the trees are stored; predictions come with each result either way.
    """
    from bcrl.q.forest.trees import grow_forest  # which imports numba

    limits = tuple(2**62 if x is None else int(x) for x in astuple(settings))

    def fit(task: Regression) -> ForestFit:
        data = task.x, task.y, task.multiplicity, task.tree_seeds, task.queries
        grown = grow_forest(*data, limits, keep)
        nodes, values, first, depths, fitted, queried = grown
        forest = Forest(nodes, values, first, depths, task.x.shape[1])
        return ForestFit(forest if keep else None, fitted, queried)

    return _spread(fit, regressions, threads)


def predict_forests(
    forests: Sequence[Forest], x: Sequence[np.ndarray], *, threads: int = 1
) -> list[np.ndarray]:
    """The predictions (n,) float64 of each forest at its own x (n, d)."""
    from bcrl.q.forest.descent import predict_addressed  # which imports numba

    at_least("threads", threads, 1)
    table, points = [], []
    for forest, given in zip(forests, x, strict=True):
        own = _points("x", given, forest.n_features)
        arrays = (forest.nodes, forest.values, forest.first, own)
        places = (array.ctypes.data for array in arrays)
        table.append((*places, len(forest.depths), *own.shape))
        points.append(own)  # whose memory must last
    share = max(1, math.ceil(len(table) / threads))
    parts = [table[i : i + share] for i in range(0, len(table), share)]
    found = _spread(lambda part: predict_addressed(np.array(part)), parts, threads)
    return [means for part in found for means in part]


def _spread(function: Callable, items: Sequence, threads: int) -> list:
    """The results of `function` for all items, on up to `threads` threads."""
    at_least("threads", threads, 1)
    threads = min(threads, len(items))
    if threads <= 1:
        return list(map(function, items))
    return list(_pool(min(threads, 4 * (os.cpu_count() or 1))).map(function, items))


def _points(name: str, x: np.ndarray, d: int | None = None) -> np.ndarray:
    """`x` as finite (n, d) float32 in C order, uncopied if it is that already."""
    x = np.ascontiguousarray(x, np.float32)
    if x.ndim != 2 or x.shape[1] < 1 or (d or x.shape[1]) != x.shape[1]:
        raise BcrlError(f"{name} has shape {x.shape}, not (rows, {d or 'features'})")
    if not np.isfinite(x).all():
        raise BcrlError(f"{name} holds NaN, infinity or values too large for float32")
    return x
