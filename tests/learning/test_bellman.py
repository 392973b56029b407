"""Targets of each kind of boosting by hand; shaped rewards keep the policy."""

import numpy as np
import pytest

from bcrl.evaluation.oracle.maze import optimal_q
from bcrl.learning.bellman import precompute_target, residual_target, shaping
from bcrl.learning.rollout import transition_tables
from bcrl.learning.transfer import Boost
from bcrl.q.functions import ZERO, Shaped, Table
from tests.toys import Corridor

# Rewards of three transitions, and which of them is absorbing; γ = 0.9.
STEPS = np.array([-1.0, 0.0, 2.0]), np.array([False, True, False])
NEXT_BASE = np.array([[1.0, 3.0], [2.0, 5.0], [-4.0, -1.0]])
NEXT_RESIDUAL = np.array([[2.0, -1.0], [1.0, 1.0], [0.0, 3.0]])
BASE = np.array([0.5, 0.25, -2.0])


def target(base, next_base, boost):
    inside, fixed, discount = precompute_target(*STEPS, next_base, base, 0.9, boost)
    return fixed + discount * (NEXT_RESIDUAL + inside).max(-1)


@pytest.mark.parametrize(
    ("boost", "expected"),
    [
        # max of the sum: 3, –, 2; sum of the maxima: 2 + 3, –, 3 − 1
        (Boost(), [-1 + 2.7 - 0.5, -0.25, 2 + 1.8 + 2]),
        (Boost(greedy_on="residual"), [1.2, -0.25, 5.8]),
        (Boost(maxima="two"), [-1 + 4.5 - 0.5, -0.25, 5.8]),
        (Boost(mask_at_goal=False), [1.2, 4.5 - 0.25, 5.8]),
        (Boost("residual", "two", False), [3.0, 4.25, 5.8]),
    ],
)
def test_the_target_of_each_boost_by_hand(boost, expected):
    assert target(BASE, NEXT_BASE, boost).tolist() == pytest.approx(expected)
    plain = target(np.zeros(3), np.zeros((3, 2)), boost)
    assert plain.tolist() == pytest.approx([-1 + 1.8, 0.0, 2 + 2.7])
    if boost == Boost():
        equation_5 = residual_target(*STEPS, NEXT_BASE + NEXT_RESIDUAL, BASE, 0.9)
        assert np.allclose(target(BASE, NEXT_BASE, boost), equation_5)


@pytest.mark.parametrize("seed", range(3))
def test_shaping_shifts_q_by_minus_v_and_keeps_the_greedy_policy(seed):
    env = Corridor(prize=2.0)
    index, reward, absorbing = transition_tables(env)
    v = np.random.default_rng(seed).standard_normal(6) * 5.0
    extra = shaping(np.repeat(v[:, None], 2, 1), v[index], absorbing, env.gamma, True)
    plain = optimal_q(index, reward, absorbing, env.gamma)
    shaped = optimal_q(index, reward + extra, absorbing, env.gamma)
    assert np.allclose(shaped, plain - v[:, None], atol=1e-9)
    assert np.array_equal(shaped.argmax(1), plain.argmax(1))
    tables = (Table([t], env) for t in (shaped, np.repeat(v[:, None], 2, 1)))
    assert np.allclose(Shaped(ZERO, *tables)([env.states()], 2)[0], plain, atol=1e-9)
