"""Episodes in lockstep: both ways of walking agree, returns and ends are right."""

import numpy as np

from bcrl.common.seeding import stream
from bcrl.envs.maze import Maze
from bcrl.learning.rollout import draws, rollout, starts_and_draws
from bcrl.q.functions import ZERO, Table
from tests.toys import Corridor, OpenCorridor


def play(env, q, epsilon, seeds=(0, 1), episodes=7):
    rngs = [stream(seed, "data") for seed in seeds]
    return rollout(env, q, *starts_and_draws(rngs, env, episodes), epsilon)


def tables(env, seeds=2):
    rng = np.random.default_rng(1)
    values = rng.integers(3, size=(seeds, len(env.states()), env.n_actions)) * 1.0
    return Table(list(values), env)  # small integers: many ties


def test_the_tabular_walk_equals_the_general_rollout():
    for env, open_env in [(Corridor(), OpenCorridor())]:
        for epsilon in (0.0, 0.3, 1.0):
            q = tables(env)
            fast, plain = play(env, q, epsilon), play(open_env, q, epsilon)
            for name in ("length", "reward", "absorbing", "state"):
                assert np.array_equal(getattr(fast, name), getattr(plain, name)), name
            live = np.arange(env.horizon) < fast.length[..., None]
            assert np.array_equal(fast.action[live], plain.action[live])


def test_a_seed_plays_alone_as_it_does_among_others():
    env = Maze(0.05)
    rng = np.random.default_rng(2)
    values = [rng.random((441, 4)) for _ in range(3)]
    together = play(env, Table(values, env), 0.2, seeds=(0, 1, 2))
    alone = play(env, Table(values[2:], env), 0.2, seeds=(2,))
    assert np.array_equal(together.state[2], alone.state[0])


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


def test_an_unlearned_q_walks_at_random():
    played = play(Corridor(), ZERO, 0.0, episodes=500)
    live = np.arange(30) < played.length[..., None]
    assert abs(played.action[live].mean() - 0.5) < 0.05
