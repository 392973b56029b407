"""The forest behind scikit-learn's interface: its own checks, weights, importances."""

import numpy as np
import pytest
from sklearn.ensemble import ExtraTreesRegressor
from sklearn.utils.estimator_checks import parametrize_with_checks

from bcrl.q.forest.estimator import ExtraTrees
from tests.q.test_forest import dyadic


@parametrize_with_checks(
    [ExtraTrees(n_estimators=5), ExtraTrees(20, max_depth=9, max_features="sqrt")]
)
def test_estimator_passes_scikit_learns_own_checks(estimator, check):
    check(estimator)


def three_features(n=300):
    rng = np.random.default_rng(5)
    x = rng.uniform(-1, 1, (n, 3)).astype(np.float32)
    return x, dyadic(2 * x[:, 0] + x[:, 1] ** 2 + rng.normal(0, 0.1, n))


@pytest.mark.parametrize(
    ("most", "tried"),
    [(None, 7), (1.0, 7), (0.5, 3), (0.01, 1), ("sqrt", 2), ("log2", 2), (3, 3)],
)
def test_max_features_counts_as_scikit_learns(most, tried):
    x = np.random.default_rng(0).normal(size=(60, 7)).astype(np.float32)
    y = x @ np.arange(7.0)
    theirs = ExtraTreesRegressor(1, max_features=most or 1.0).fit(x, y)
    assert theirs.estimators_[0].max_features_ == tried
    one, same, more = (
        ExtraTrees(4, max_features=m, random_state=1).fit(x, y).forest_.nodes.tobytes()
        for m in (most, tried, tried + 1)
    )
    assert one == same and (tried == 7 or one != more)


def test_importances_are_scikit_learns():
    x, y = three_features()
    counts = np.random.default_rng(3).integers(0, 4, len(x))
    settings = {"min_samples_leaf": 4, "random_state": 0}
    ours = ExtraTrees(300, **settings).fit(x, y, counts)
    repeated = np.repeat(np.arange(len(x)), counts)
    theirs = ExtraTreesRegressor(300, **settings).fit(x[repeated], y[repeated])
    found = ours.feature_importances_
    np.testing.assert_allclose(found, theirs.feature_importances_, atol=0.01)
    assert found.sum() == pytest.approx(1.0) and found.argmax() == 0
    joint = ExtraTrees(300, n_jobs=2, **settings).fit(x, y, counts)
    assert np.array_equal(joint.feature_importances_, found)
    x *= 0  # a later change of the data changes no importance
    assert np.array_equal(ours.feature_importances_, found)
    flat = ExtraTrees(5).fit(x, y)
    assert flat.feature_importances_.tolist() == [0, 0, 0]


def test_weights_are_repeated_rows_and_jobs_change_nothing():
    x, y = three_features(80)
    counts = np.random.default_rng(0).integers(0, 4, 80)
    rows = np.repeat(np.arange(80), counts)
    expected = ExtraTrees(5, random_state=2).fit(x[rows], y[rows]).predict(x)
    model = ExtraTrees(5, random_state=2, n_jobs=4)
    for given in (
        {"sample_weight": counts},
        {"sample_weight": counts.astype(float).tolist()},
        {"multiplicity": counts},
    ):
        assert np.array_equal(model.fit(x, y, **given).predict(x), expected)


@pytest.mark.parametrize("name", ["sample_weight", "multiplicity"])
@pytest.mark.parametrize("value", [0.5, -1, np.nan, np.inf, 2.0**41])
def test_other_weights_than_whole_numbers_are_rejected(name, value):
    x, y = three_features(10)
    weights = np.ones(10)
    weights[4] = value
    with pytest.raises(ValueError, match=r"sample_weight"):
        ExtraTrees(2).fit(x, y, **{name: weights})


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("max_features", x) for x in (0, -1, 0.0, 1.5, "auto", [1])),
        *(("max_depth", x) for x in (0, -3, 2.5, "deep")),
        *(("n_jobs", x) for x in (0, 1.5, "all")),
        *(("n_estimators", x) for x in (0, 2.5, None)),
        *(("min_samples_split", x) for x in (1, 0.5)),
        *(("min_samples_leaf", x) for x in (0, 0.5)),
    ],
)
def test_a_bad_parameter_is_rejected_by_name_and_value(key, value):
    x, y = three_features(10)
    with pytest.raises(ValueError, match=key) as raised:
        ExtraTrees().set_params(**{key: value}).fit(x, y)
    assert str(value) in str(raised.value)
