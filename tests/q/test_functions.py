"""Sums, shaped and memoized Q-functions."""

import numpy as np
import pytest

from bcrl.common import plugins
from bcrl.learning.stage import SeedBatch
from bcrl.learning.transfer import StageInit
from bcrl.q.functions import ZERO, Mapped, Shaped, Sum
from bcrl.q.regressors import base
from bcrl.q.regressors.ours import ForestRegressor
from bcrl.q.regressors.scikit import Sklearn


class Counting:
    """A Q-function that counts the states that it is queried at."""

    queried = 0

    def __call__(self, states, n_actions):
        self.queried += sum(map(len, states))
        return [np.repeat(x[:, :1] + 1.0, n_actions, 1) for x in states]


def test_stages_stacked_with_shaping_and_boosting_are_queried_once_each():
    q = first = Counting()
    for _ in range(10):
        q = Shaped(q, ZERO, q)
    assert (q([np.zeros((3, 1))], 2)[0] == 2.0**10).all() and first.queried == 3


@pytest.mark.parametrize("stacked", [True, False])
def test_a_memoized_q_is_the_same_q_queried_once_per_state(stacked):
    q = Counting()
    start = StageInit(base=q).memoized()
    assert start.potential is ZERO and StageInit().memoized() == StageInit()
    states = np.random.default_rng(0).normal(size=(2, 4, 3))
    for rows in (slice(0, 2), slice(1, 4), slice(0, 0), slice(0, 4)):
        now = states[:, rows] if stacked else [x[rows] for x in states]
        for x, values in zip(now, start.base(now, 2), strict=True):
            assert values.shape == (len(x), 2) and (values == x[:, :1] + 1).all()
    assert q.queried == 8  # four states of either seed


@pytest.mark.parametrize("other", [ForestRegressor(trees=4), Sklearn("Ridge")])
@pytest.mark.parametrize("threads", [1, 2])
def test_a_sum_has_the_values_of_its_terms_bit_for_bit(other, threads, monkeypatch):
    rng, seeds, terms = np.random.default_rng(0), SeedBatch((3, 4), None, threads), []
    for k, regressor in enumerate([ForestRegressor(trees=4), other, other]):
        rows: list[list[base.Fitted | None]] = [[None, None], [None, None]]
        for s, a in [(0, 0), (0, 1), (1, 0)]:  # seed 1 has never tried action 1
            x = rng.random((90, 2)).astype(np.float32)
            counts = np.ones(90, np.int64)
            problem = base.Problem(x, rng.random(90), counts, x[:0], s, (k, a))
            (fit,) = regressor.fit([problem], True, 1)
            rows[s][a] = base.Fitted.of(problem, fit)
        terms.append(base.FittedQ(rows, regressor, seeds))
    q, states = Sum(tuple(terms)), [rng.random((7, 2)), rng.random((40, 2))]
    for few in (base.FEW, 0):
        monkeypatch.setattr(base, "FEW", few)
        for s, found in enumerate(q(states, 2)):
            one, two, three = (term(states, 2)[s] for term in terms)
            assert found.shape == one.shape and (found == one + two + three).all()
            model = terms[0].models[s][0].model
            assert (model.predict(states[s]) == one[:, 0]).all()
    assert (q(np.stack([states[0]] * 2), 2)[0] == q(states, 2)[0]).all()


@pytest.mark.parametrize("stacked", [True, False])
def test_a_mapped_q_takes_no_states(stacked, monkeypatch):
    monkeypatch.setenv(plugins.VARIABLE, "tests")
    q, x = Mapped(Counting(), "tests.toys.doubled"), np.ones((2, 0, 3))
    assert [v.shape for v in q(x if stacked else [*x], 4)] == [(0, 4)] * 2
    none, some = q([x[0], np.ones((5, 3))], 4)
    assert none.shape == (0, 4) and (some == np.full((5, 4), 3.0)).all()
