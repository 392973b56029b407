"""Episodes in lockstep: both ways of walking agree, returns and ends are right."""

import numpy as np
import pytest

from bcrl.common.seeding import stream
from bcrl.learning.policies import epsilon_greedy, greedy
from bcrl.learning.rollout import draws, rollout, starts_and_draws
from bcrl.q.functions import Table
from tests.toys import Corridor, OpenCorridor


def play(env, q, epsilon, seeds=(0, 1), episodes=7):
    rngs = [stream(seed, "data") for seed in seeds]
    return rollout(env, q, *starts_and_draws(rngs, env, episodes), epsilon)


@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_the_tabular_walk_equals_the_general_rollout(epsilon):
    env = Corridor()
    rng = np.random.default_rng(1)  # small integers: many ties
    q = Table([rng.integers(3, size=(6, 2)) * 1.0 for _ in range(2)], env)
    fast, plain = play(env, q, epsilon), play(OpenCorridor(), q, epsilon)
    for name in ("length", "reward", "absorbing", "state"):
        assert np.array_equal(getattr(fast, name), getattr(plain, name)), name
    live = np.arange(env.horizon) < fast.length[..., None]
    assert np.array_equal(fast.action[live], plain.action[live])


def test_epsilon_one_never_asks_for_values():
    def unasked(states, n_actions):
        raise AssertionError

    played = play(Corridor(), unasked, 1.0)
    assert set(np.unique(played.action)) == {0, 1}


def test_exploration_happens_at_rate_epsilon():
    env = Corridor()
    right = Table([np.tile([0.0, 1.0], (6, 1))] * 2, env)
    played = play(env, right, 0.5, episodes=2000)
    live = np.arange(env.horizon) < played.length[..., None]
    assert abs((played.action[live] == 1).mean() - 0.75) < 0.02


def test_discounted_return_by_hand():
    env = Corridor(prize=2.0, gamma=0.5)
    right = Table([np.tile([0.0, 1.0], (6, 1))], env)
    u = draws([stream(0, "evaluation")], env, 1)
    played = rollout(env, right, np.full((1, 1, 1), 3.0), u)
    assert played.length.tolist() == [[2]]
    assert played.discounted_return(0.5).tolist() == [[-0.1 + 0.5 * 2.0]]
    assert played.solved().all()
    assert played.state[0, 0, :3, 0].tolist() == [3, 4, 5]


def test_greedy_takes_the_maximum_and_breaks_ties_uniformly():
    q = np.array([[0.0, 2.0, 1.0], [3.0, -1.0, 2.0]])
    assert greedy(q, np.array([0.99, 0.0])).tolist() == [1, 0]
    q, u = np.tile([5.0, 1.0, 5.0, 5.0], (9000, 1)), (np.arange(9000) + 0.5) / 9000
    counts = np.bincount(greedy(q, u), minlength=4)
    assert counts.tolist() == [3000, 0, 3000, 3000]


def test_random_actions_are_all_and_only_actions():
    u = np.array([[0.0, 0.2499, 0.25, 0.75, np.nextafter(1, 0)]])
    q = np.tile([0.0, 0.0, 1.0, 0.0], (1, 5, 1))
    epsilon = np.array([0.6, 0.6, 0.6, 0.5, 0.0])
    found = epsilon_greedy(q, np.full((1, 5), 0.5), u, epsilon)
    assert found.tolist() == [[0, 0, 1, 2, 2]]
    assert epsilon_greedy(q, u, u, 1.0).tolist() == [[0, 0, 1, 3, 3]]
