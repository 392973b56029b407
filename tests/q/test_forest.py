"""The forest engine against scikit-learn's distribution and against arithmetic."""

import hashlib
import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from sklearn.ensemble import ExtraTreesRegressor

from bcrl.errors import BcrlError, ConfigError
from bcrl.q.forest import descent, lanes, split, trees
from bcrl.q.forest.forest import (
    Regression,
    TreeSettings,
    fit_forests,
    predict_forests,
)

PAPER = TreeSettings(min_samples_split=5, min_samples_leaf=2)
SEEDS = 200  # forests per side of a comparison
TREES = 3


def seeds(number: int, key: int = 0) -> np.ndarray:
    return np.random.default_rng(key).integers(0, 2**64, number, dtype=np.uint64)


def dyadic(y: np.ndarray) -> np.ndarray:
    """`y` in steps of 1/256: sums and variances are then exact in scikit-learn too."""
    return np.round(y * 256) / 256


def problem(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray]:
    """x, y, multiplicity and test points."""
    rng = np.random.default_rng(7)
    grid, counts = np.stack(np.meshgrid(*[np.arange(9)] * 2), -1).reshape(-1, 2), None
    if name == "continuous":
        x, points = rng.uniform(-1, 1, (250, 2)), rng.uniform(-1.2, 1.2, (12, 2))
        y = np.sin(4 * x[:, 0]) + (x[:, 1] > 0.2) + rng.normal(0, 0.2, 250)
    elif name == "lattice":
        x, points = grid / 8, rng.uniform(0, 1, (12, 2))
        y, counts = -np.abs(x - 0.75).sum(1), rng.integers(1, 6, 81)
    elif name == "ties":
        x, points = grid[(grid < 4).all(1)] / 4, rng.uniform(0, 0.75, (12, 2))
        y = (np.arange(16) % 5 == 0).astype(float)
    else:  # one feature is constant, one has few values, two may be equal
        d = int(name.split()[0])
        x, points = rng.normal(size=(120, d)), rng.normal(size=(12, d))
        x[:, 1], x[:, 2] = 0.25, np.round(x[:, 2])
        x[:, d // 2 :: 5] = x[:, [d // 2]]
        y, counts = x[:, 0] * x[:, 2] + x[:, 3], rng.integers(1, 4, 120)
    return x.astype(np.float32), dyadic(y), counts, points.astype(np.float32)


def sample(name: str, settings: TreeSettings, how: str) -> np.ndarray:
    """A row per forest seed: predictions at the test points, nodes, depth."""
    x, y, counts, points = problem(name)
    out = np.empty((SEEDS, len(points) + 2))
    if how != "multiplicity" and counts is not None:
        x, y, counts = np.repeat(x, counts, 0), np.repeat(y, counts), None
    for k in range(SEEDS):
        if how == "scikit-learn":
            given = asdict(settings) | {"max_features": settings.max_features or 1.0}
            model = ExtraTreesRegressor(TREES, random_state=k, **given).fit(x, y)
            trees = [tree.tree_ for tree in model.estimators_]
            nodes = [tree.node_count for tree in trees]
            depths = [tree.max_depth for tree in trees]
            predicted = model.predict(points)
        else:
            key = 10_000 * (1 + ("repeated", "multiplicity").index(how)) + k
            task = Regression(x, y, seeds(TREES, key), counts, points)
            fit = fit_forests([task], settings)[0]
            nodes, depths = np.diff(fit.forest.first), fit.forest.depths
            predicted = fit.queried
        out[k] = *predicted, np.mean(nodes), np.mean(depths)
    return out


COMPARED = [
    ("continuous", PAPER),
    ("continuous", TreeSettings(2, 1)),
    ("lattice", PAPER),
    ("lattice", TreeSettings(9, 4)),
    ("ties", TreeSettings(2, 1)),
    ("4 features", PAPER),
    ("4 features", TreeSettings(4, 1, max_features=1)),
    ("4 features", TreeSettings(2, 2, max_features=2)),
    ("4 features", TreeSettings(max_depth=2)),
    ("8 features", PAPER),
    ("16 features", TreeSettings(2, 1)),
    ("continuous", TreeSettings(max_depth=5)),
]


def p_values(one: np.ndarray, other: np.ndarray) -> list[float]:
    """Equality of mean, spread and distribution, column by column."""
    found = []
    for a, b in zip(one.T, other.T, strict=True):
        if np.ptp(np.concatenate([a, b])) > 1e-12:
            found.append(stats.ttest_ind(a, b, equal_var=False).pvalue)
            found.append(stats.levene(a, b, center="median").pvalue)
            found.append(stats.ks_2samp(a, b).pvalue)
    return found


def test_same_distribution_as_scikit_learn():
    """No difference at family-wise level 0.001 (Bonferroni over all tests)."""
    tests, least = 0, {}
    for name, settings in COMPARED:
        theirs = sample(name, settings, "scikit-learn")
        for how in ("repeated", "multiplicity"):
            found = p_values(theirs, sample(name, settings, how))
            tests, least[name, settings, how] = tests + len(found), min(found)
    assert tests > 500
    assert min(least.values()) > 0.001 / tests, least


def test_the_comparison_notices_a_wrong_setting():
    theirs = sample("continuous", PAPER, "scikit-learn")
    wrong = sample("continuous", TreeSettings(5, 3), "repeated")
    assert min(p_values(theirs, wrong)) < 1e-9


@pytest.mark.parametrize("name", ["lattice", "4 features"])
@pytest.mark.parametrize("most", [None, 1])
def test_multiplicities_are_repeated_rows_bit_for_bit(name, most):
    x, y, counts, points = problem(name)
    order = np.random.default_rng(1).permutation(counts.sum())
    rows = np.repeat(np.arange(len(x)), counts)[order]
    y = y + np.random.default_rng(2).normal(size=len(y))
    given = (x, y, counts), (x[rows], y[rows], None), (x[rows], y[rows], rows * 0 + 1)
    tasks = [Regression(x, y, seeds(20), counts, points) for x, y, counts in given]
    one, *others = fit_forests(tasks, TreeSettings(7, 3, max_features=most))
    for other in others:
        assert one.forest.nodes.tobytes() == other.forest.nodes.tobytes()
        assert one.forest.values.tobytes() == other.forest.values.tobytes()
        assert one.queried.tobytes() == other.queried.tobytes()
        assert (one.fitted[rows] == other.fitted).all()
        assert other.fitted.mean() == pytest.approx(y[rows].mean())  # means of leaves
    memory = one.forest.nodes.nbytes + one.forest.values.nbytes
    assert memory <= 16.2 * len(one.forest.nodes)  # bytes


@pytest.mark.parametrize("d", [3, 4, 7, 33])
@pytest.mark.parametrize("weighted", [False, True])
def test_splits_by_vectors_are_the_scalar_references_bit_for_bit(d, weighted):
    rng = np.random.default_rng(d)
    for n in (2, 9, 300):
        x = rng.normal(size=(n, d)).astype(np.float32)
        x[:, : d // 2] = np.round(x[:, : d // 2])  # ties, and some constant features
        rows = trees._new_rows(x, weighted)
        rows.target[:n] = y = rng.integers(-9, 9, n)
        counts = rng.integers(1, 4, n) if weighted else np.ones(n, np.int64)
        rows.weight[:n] = counts[: rows.weight.size]
        node = split.U(0), split.U(n), counts.sum(), counts @ y
        width = split.U(trees._width(d))
        orders = np.arange(d), np.arange(d)
        for state in map(split.U, range(20)):
            one = split.choose(rows, width, *node, (2, d), state, orders[0])
            sums = lanes.new_sums(width)
            other = lanes.choose_all(rows, *node, 2, state, orders[1], sums)
            assert one == other and (orders[0] == orders[1]).all()


def hill(n: int, key: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(key)
    x = rng.uniform([-1, -3], [1, 3], (n, 2)).astype(np.float32)
    return x, np.sign(x[:, 1]) * 0.95 ** np.floor(9 * (1 - x[:, 0])) * (x[:, 0] > -0.5)


@pytest.mark.parametrize("d", [1, 2, 3, 600])
def test_predictions_while_growing_are_the_forests_bit_for_bit(d):
    rng = np.random.default_rng(d)
    x, queries = rng.normal(size=(900, d)), rng.normal(size=(2000, d))
    y = rng.normal(size=900)
    assert descent.CACHED // 600 < len(queries) < descent.CACHED // 3  # in two parts
    fit = fit_forests([Regression(x, y, seeds(7), None, queries)], PAPER)[0]
    assert (fit.forest.predict(x) == fit.fitted).all()
    assert (fit.forest.predict(queries) == fit.queried).all()
    # Few rows are walked down the trees, many are sorted down.
    few = [fit.forest.predict(part) for part in np.array_split(queries, 100)]
    assert len(queries) / 100 < descent.TOGETHER < len(queries) / 3
    assert (np.concatenate(few) == fit.queried).all()


def test_one_feature_has_the_trees_of_two_of_which_one_is_constant():
    x, y = hill(500, 0)
    tasks = [Regression(rows, y, seeds(5)) for rows in (x[:, :1], x * [1, 0])]
    one, two = (fit.forest for fit in fit_forests(tasks, PAPER))
    assert one.nodes.tobytes() == two.nodes.tobytes()


def test_neither_threads_nor_other_forests_nor_keeping_change_a_forest():
    tasks = [
        Regression(*hill(300 + 50 * k, k), seeds(5, k), None, hill(40, 99)[0])
        for k in range(6)
    ]
    alone = [fit_forests([task], PAPER)[0] for task in tasks]
    for threads, keep in ((1, True), (4, True), (3, False)):
        fits = fit_forests(tasks, PAPER, threads=threads, keep=keep)
        for one, other in zip(alone, fits, strict=True):
            assert one.fitted.tobytes() == other.fitted.tobytes()
            assert one.queried.tobytes() == other.queried.tobytes()
            if other.forest is not None:
                assert one.forest.nodes.tobytes() == other.forest.nodes.tobytes()
    assert fits[0].forest is None
    forests, points = [fit.forest for fit in alone], [task.x for task in tasks]
    for threads in (1, 4):
        found = predict_forests(forests, points, threads=threads)
        for got, one in zip(found, alone, strict=True):
            assert (got == one.fitted).all()
    assert predict_forests([], []) == []
    for few in (0, 1, 20, 200):  # the rows of all forests walk
        found = predict_forests(forests, [x[:few] for x in points])
        for got, one in zip(found, alone, strict=True):
            assert (got == one.fitted[:few]).all()


def digest() -> str:
    """Forests of two features, of many sizes, and their predictions, as a hash."""
    found = hashlib.sha256()
    for n in (*range(1, 40), 1000):
        x, y = hill(n, n)
        counts = np.random.default_rng(n).integers(1, 4, n) if n % 2 else None
        queries, _ = hill(3 * n, n + 1)
        (fit,) = fit_forests([Regression(x, y, seeds(2), counts, queries)], PAPER)
        parts = fit.forest.nodes, fit.forest.values, fit.fitted, fit.queried
        for part in (*parts, fit.forest.predict(np.tile(queries, (40, 1)))):
            found.update(part.tobytes())
    return found.hexdigest()


@pytest.mark.slow
def test_a_processor_without_vectors_gives_the_same_bytes(tmp_path):
    code = "from tests.q.test_forest import digest; print(digest())"
    plain = {"NUMBA_CPU_NAME": "generic", "NUMBA_CACHE_DIR": str(tmp_path)}
    root = Path(__file__).parents[2]
    given = {"env": os.environ | plain, "cwd": root, "text": True}
    found = subprocess.check_output([sys.executable, "-c", code], **given)
    assert found.strip() == digest()


@pytest.mark.parametrize("scale", [1e-290, 1e-9, 1.0, 1e12, 1e300])
def test_every_scale_of_targets_is_interpolated(scale):
    x, _ = hill(200, 5)
    y = np.random.default_rng(0).normal(size=200) * scale
    fit = fit_forests([Regression(x, y, seeds(3))], TreeSettings())[0]
    if scale > 1e-8:
        np.testing.assert_allclose(fit.fitted, y, rtol=0, atol=1e-14 * np.abs(y).max())
    else:  # a variance below float64's eps counts as none, as in scikit-learn
        assert not fit.forest.depths.any()
        np.testing.assert_allclose(fit.fitted, y.mean(), atol=1e-14 * np.abs(y).max())


def test_constant_targets_and_constant_features_give_one_leaf():
    x, _ = hill(50, 0)
    for rows, y, counts, mean in (
        (x, np.full(50, -1.85), None, -1.85),
        (np.full((50, 2), 3), np.arange(50.0), None, 24.5),
        (x[:1], [0.3], [9], 0.3),
    ):
        (fit,) = fit_forests([Regression(rows, y, seeds(4), counts)], TreeSettings())
        assert not fit.forest.depths.any()
        np.testing.assert_allclose(fit.fitted, mean, rtol=1e-14)


def test_bad_input_is_rejected():
    x, y = hill(20, 0)
    good = {"x": x, "y": y, "tree_seeds": seeds(2)}
    for bad, message in (
        ({"x": x[0]}, "shape"),
        ({"x": np.full_like(x, np.nan)}, "NaN"),
        ({"y": y[1:]}, "shape"),
        ({"y": np.full_like(y, np.inf)}, "infinity"),
        ({"tree_seeds": seeds(0)}, "tree_seeds"),
        ({"multiplicity": np.zeros(20, np.int64)}, "multiplicity"),
        ({"queries": x[:, :1]}, "queries"),
    ):
        with pytest.raises(BcrlError, match=message):
            fit_forests([Regression(**(good | bad))], PAPER)
    for settings in ((1,), (2, 0), (2, 1, 0), (2, 1, None, 0)):
        with pytest.raises(ConfigError, match="at least"):
            TreeSettings(*settings)
    with pytest.raises(ConfigError, match="threads"):
        fit_forests([Regression(**good)], PAPER, threads=0)
