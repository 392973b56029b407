"""Folding: what one approximator keeps of a sum, and when it takes its place."""

import numpy as np
import pytest
import torch
from sklearn.linear_model import Lasso, LinearRegression, PoissonRegressor, Ridge

from bcrl.api import Boost, stages
from bcrl.envs.linear_system import LinearSystem
from bcrl.envs.maze import Maze
from bcrl.errors import ConfigError
from bcrl.learning.distillation import distilled, units_of
from bcrl.learning.dqn import DQN
from bcrl.learning.folding import Folded
from bcrl.learning.fqi import FQI
from bcrl.learning.stage import SeedBatch, learn
from bcrl.q.functions import Sum, Table
from bcrl.q.linear import Linear
from bcrl.q.networks.cpu import outputs
from bcrl.q.networks.mlp import Adam, DeepQ, Networks, xavier
from bcrl.q.networks.units import InUnits
from bcrl.q.regressors.base import FittedQ
from bcrl.q.regressors.ours import ForestRegressor, Tabular
from bcrl.q.regressors.scikit import Sklearn
from tests.toys import Corridor, OpenCorridor

FOLD = Boost(fold="always")
PRIZES = (1.0, 1.5, 2.0, 2.5)


def ends(boost, tasks, learner, seeds=(0, 1), probe=None):
    """The last snapshot of each stage."""
    probe = tasks[-1].evaluation_states() if probe is None else probe
    course = stages(tasks, learner, boost)
    return [now for now in learn(course, SeedBatch(seeds, probe)) if now.last_of_stage]


@pytest.mark.parametrize(
    ("fold", "folded"),
    [
        ("never", []),
        ("always", [2, 3, 4, 5, 6, 7]),
        (1, [2, 3, 4, 5, 6, 7]),
        (2, [3, 5, 7]),
        (3, [4, 7]),
        (9, []),
    ],
)
def test_so_many_residuals_are_the_most_that_q_has(fold, folded):
    boost = Boost(fold=fold)
    assert [n for n in range(1, 8) if boost.folds(n)] == folded
    made = ends(boost, [OpenCorridor(p) for p in (*PRIZES, 3, 4, 5)], FQI(2, 30))
    sizes = [len(getattr(now.result.q, "terms", (0,))) for now in made]
    assert max(sizes) <= (7 if fold == "never" else 1 if fold == "always" else fold)
    assert [now.stage.number for now in made if now.folded] == folded


@pytest.mark.parametrize("fold", ["sometimes", 0, -1, 1.5, True, None])
def test_other_values_are_refused(fold):
    with pytest.raises(ConfigError, match=r"boosting.fold="):
        Boost(fold=fold)


def test_a_loss_must_be_positive_and_the_agent_act_on_the_sum():
    with pytest.raises(ConfigError, match="fold_loss"):
        Boost(fold_loss=0.0)
    with pytest.raises(ConfigError, match="residual alone"):
        Boost(fold="always", greedy_on="residual")


def test_the_changes_are_those_of_values_and_of_greedy_actions():
    before = [np.array([[1.0, 1.0], [2.0, 0.0], [0.0, 3.0], [0.0, 1.0]])]
    after = [np.array([[1.0, 1.5], [2.0, 2.5], [0.0, 3.0], [0.0, 1.0]])]
    found = Folded.of(Table([], Corridor()), before, after)
    assert found.facts(0) == {
        "max_change": 2.5,
        "mean_change": 3.0 / 8,
        "greedy_changed": 0.25,  # a tie that becomes a preference is no change
    }


@pytest.mark.parametrize("regressor", [Tabular(), ForestRegressor(trees=5)])
def test_a_table_is_folded_exactly(regressor):
    tasks = [Maze(height=h) for h in (0.05, 0.25, 0.45)]
    learner, probe = FQI(4, 30, regressor=regressor), tasks[0].states()
    one, many = (ends(b, tasks, learner, probe=probe) for b in (FOLD, Boost()))
    for a, b in zip(one, many, strict=True):
        assert np.array_equal(a.probed_q, b.probed_q)
        assert isinstance(a.result.q, Table)
    assert one[-1].result.residual is one[-1].result.q
    assert one[-1].folded.max_change.tolist() == [0.0, 0.0]
    assert one[-1].folded.greedy_changed.tolist() == [0.0, 0.0]
    assert np.array_equal(
        one[-1].folded.residual.values, many[-1].result.residual.values
    )


@pytest.mark.parametrize("estimator", [LinearRegression(), Ridge(3.0), Lasso(0.01)])
@pytest.mark.parametrize("standardise", [False, True])
def test_linear_models_are_folded_exactly(estimator, standardise):
    tasks = [OpenCorridor(prize) for prize in PRIZES]
    learner = FQI(3, 40, regressor=Sklearn(estimator, standardise=standardise))
    one, many = (ends(boost, tasks, learner) for boost in (FOLD, Boost()))
    states = np.random.default_rng(0).uniform(-20, 20, (2, 50, 1))
    a, b = (np.array(runs[1].result.q(states, 2)) for runs in (one, many))
    assert np.allclose(a, b, atol=1e-12 * np.abs(b).max(), rtol=0)
    assert one[-1].folded.max_change.max() < 1e-5  # scikit-learn fits float32 as such
    assert isinstance(one[-1].result.q, Linear)
    assert isinstance(many[-1].result.q, Sum)


def test_models_that_are_no_sums_are_fitted_again():
    """A Poisson regression has coefficients, but predicts their exponential."""
    tasks = [OpenCorridor(prize) for prize in PRIZES]
    made = ends(FOLD, tasks, FQI(2, 40, regressor=Sklearn(Positive())))
    assert isinstance(made[-1].result.q, FittedQ)


class Positive(PoissonRegressor):
    """A Poisson regression of targets that may be negative."""

    def fit(self, x, y, sample_weight=None):
        return super().fit(x, np.maximum(y, 0.01), sample_weight)


def test_a_forest_is_fitted_to_the_sum_at_all_points():
    tasks = [OpenCorridor(prize) for prize in PRIZES]
    learner = FQI(5, 40, regressor=ForestRegressor(trees=20))
    one, many = (ends(boost, tasks, learner) for boost in (FOLD, Boost()))
    states = np.tile(np.arange(5.0)[:, None], (2, 1, 1))
    a, b = (np.array(runs[1].result.q(states, 2)) for runs in (one, many))
    assert np.allclose(a, b, rtol=0, atol=1e-9)
    change = one[1].folded  # half-way between them
    assert 0 < change.mean_change.max() < 0.2 and change.greedy_changed.max() == 0.0
    # What was recorded at the probed state is what the folded Q says.
    assert one[1].probed_q[0] == pytest.approx(a[0][:1])
    # The next stage has the folded Q as its base.
    base = one[2].result.q
    assert isinstance(base, FittedQ)


@pytest.mark.parametrize("task", [OpenCorridor, Corridor])
def test_a_seeds_fold_does_not_depend_on_the_others(task):
    tasks, learner = [task(prize) for prize in PRIZES], FQI(3, 20)
    both, alone = (ends(FOLD, tasks, learner, seeds) for seeds in ((4, 9), (9,)))
    for a, b in zip(both, alone, strict=True):
        assert a.probed_q[1].tobytes() == b.probed_q[0].tobytes()


# --- networks ---


def sums(n=2000, seed=0):
    """States far from 0, and a quadratic plus ripples for three actions."""
    rng = np.random.default_rng(seed)
    x = rng.normal([-4.0, 100.0], [2.0, 30.0], size=(n, 2))
    z = (x - [-4.0, 100.0]) / [2.0, 30.0]
    v = -500.0 + 40.0 * (z**2).sum(1)
    return x, np.stack([v + 10.0 * np.sin(z[:, 0] + a) for a in range(3)], 1)


def test_distillation_keeps_its_loss_and_returns_a_network_of_plain_states():
    x, y = sums()
    rows = np.stack([xavier(np.random.default_rng(0), SIZES)] * 2)
    online = Networks(SIZES, torch.from_numpy(rows))
    units = units_of(DeepQ(online, online, Adam.of(online.flat, 1e-4)), [y - 1.0, y])
    found = distilled(units, 1, x, y, 0.05, seed=3, stage=2)
    assert found.error <= 0.05
    z = outputs(found.flat[None], np.array(SIZES), np.float32(x)[None])[0].astype(float)
    assert np.array_equal(units.plain(1, z), found.values)
    v, now = y.mean(1), found.values.mean(1)
    parts = (now - v) / v.std(), ((found.values - y).T - (now - v)) / (y.T - v).std()
    error = np.sqrt(np.mean((parts[0] + parts[1]) ** 2))  # of V, of the advantages
    assert error == pytest.approx(found.error, rel=1e-6)
    assert np.allclose(units.plain(1, units.in_units(1, y)), y)


def test_what_was_folded_can_be_trained_further():
    boost = Boost(fold="always", fold_loss=0.5)
    q = ends(boost, TASKS[:2], SMALL)[-1].result.q
    states = np.random.default_rng(1).normal(size=(2, 9, 4))
    whole, own = np.array(q(states, 8)), np.array(q.absorbed()(states, 8))
    assert isinstance(q, InUnits) and np.allclose(whole, own, rtol=1e-4, atol=1e-3)


SIZES = (2, 64, 64, 3)
SMALL = DQN(120, 0, learning_starts=20, hidden=(16,), evaluation_episodes=2)
TASKS = [LinearSystem(drift=d) for d in (0.0, -0.25, -0.5)]


def test_dqns_folded_sum_is_one_network_that_acts_and_is_the_next_base():
    boost = Boost(fold="always", fold_loss=0.5)
    made = ends(boost, TASKS, SMALL)
    for now in made[1:]:
        assert isinstance(now.result.q, InUnits)
        assert now.result.acting.own is now.result.q is now.result.residual
        assert now.folded.facts(0)["mean_change"] > 0 and not any(now.folded.notes)
        states = np.random.default_rng(1).normal(size=(2, 2 * 2, 4))
        u = np.full((2, 4, 3), 0.99)
        best = np.array(now.result.q(states, 8)).argmax(-1)
        assert np.array_equal(now.policy(states, u, None)[:, 2:], best[:, 2:])
    alone = ends(boost, TASKS, SMALL, seeds=(1,))
    for a, b in zip(made, alone, strict=True):
        one, other = (getattr(x.result.q, "deep", x.result.q) for x in (a, b))
        assert np.array_equal(one.online.flat[1], other.online.flat[0])


def test_a_loss_out_of_reach_is_told():
    boost = Boost(fold="always", fold_loss=1e-9)
    learner = DQN(40, 0, learning_starts=20, hidden=(4,), evaluation_episodes=1)
    made = ends(boost, TASKS[:2], learner, seeds=(0,))
    assert "fold_loss=1e-09" in made[-1].folded.facts(0)["note"]


def test_forests_of_the_fold_have_their_own_random_numbers(monkeypatch):
    drawn, fit = [], ForestRegressor.fit

    def noted(self, problems, *options):
        drawn.extend(p.path for p in problems)
        return fit(self, problems, *options)

    monkeypatch.setattr(ForestRegressor, "fit", noted)
    ends(FOLD, [OpenCorridor(), OpenCorridor(2.0)], FQI(2, 20), seeds=(0,))
    assert len(set(drawn)) == len(drawn) == 2 * 2 * 2 + 2
