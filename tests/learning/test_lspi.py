"""LSPI against the Riccati equation, and its parts against plain linear algebra."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg

from bcrl.common.seeding import stream
from bcrl.envs.linear_system import LinearSystem
from bcrl.errors import BcrlError, ConfigError
from bcrl.evaluation.oracle import riccati
from bcrl.evaluation.step_metrics import evaluate
from bcrl.learning import lspi
from bcrl.learning.lspi import LSPI, improved, lstdq
from bcrl.learning.rollout import start_states
from bcrl.learning.transfer import StageInit
from bcrl.q.quadratic import FEATURES, Quadratic
from tests.toys import staged, team

LQ = LinearSystem("lq", horizon=100)
COST = np.diag([3.0, 1.0, 3.0, 1.0])


def system(gain=2.0, friction=0.1):
    """A and B of the LQ task, written out."""
    a = np.eye(4)
    a[0, 1] = a[2, 3] = 0.05
    a[1, 1] = a[3, 3] = 1.0 - 0.05 * friction
    b = np.zeros((4, 2))
    b[1, 0] = b[3, 1] = 0.05 * gain
    return a, b


def moments(seeds=(0, 1, 2), learner=None, env=LQ, before=0):
    learner = learner or LSPI()
    stage = staged(learner, env, before=before)
    return list(learner.learn(stage, StageInit(), team(*seeds)))


def gains(moment, n):
    """What each seed's policy does at the unit vectors, K (S, 2, 4)."""
    at = np.tile(np.eye(4), (n, 1, 1))
    force = moment.policy(at, np.full((n, 4, 10), 0.5), np.ones((n, 4), bool))
    return force.transpose(0, 2, 1)


@pytest.mark.parametrize("preset", ["released", "paper"])
def test_the_riccati_gain_is_brute_force_value_iterations(preset):
    env = replace(LQ, preset=preset)
    a, b = system(gain=2.0 if preset == "released" else 1.0)
    value, r = np.zeros((4, 4)), 0.1 * np.eye(2)
    for _ in range(4000):  # cost-to-go sᵀ V s; the new state is paid for
        m = COST + env.gamma * value
        k = -np.linalg.inv(r + b.T @ m @ b) @ (b.T @ m @ a)
        closed = a + b @ k
        value = closed.T @ m @ closed + k.T @ r @ k
    assert np.allclose(riccati.gain(env), k, atol=1e-10)


def test_the_riccati_gain_is_a_fixed_point_of_policy_iteration():
    a, b = system()
    k, value = riccati.gain(LQ), np.zeros((4, 4))
    closed = a + b @ k
    for _ in range(4000):  # the costs of this very gain
        value = closed.T @ (COST + LQ.gamma * value) @ closed + 0.1 * k.T @ k
    ab = np.hstack([a, b])
    matrix = -ab.T @ (COST + LQ.gamma * value) @ ab
    matrix[4:, 4:] -= 0.1 * np.eye(2)
    assert np.allclose(improved(matrix, LQ), k, atol=1e-10)


def test_no_gain_near_riccatis_earns_more():
    best, rest = riccati.gain(LQ), np.full((33, 40, 8), 0.5)
    changed = [best]
    for i, j in np.ndindex(2, 4):
        for change in (-0.2, -0.01, 0.01, 0.2):
            other = best.copy()
            other[i, j] += change
            changed.append(other)
    k = np.stack(changed).transpose(0, 2, 1)
    start = start_states(np.random.default_rng(0), LQ, 40)
    state, total = np.tile(start, (33, 1, 1)), np.zeros((33, 40))
    for t in range(1000):
        state, reward, _ = LQ.push(state, state @ k, rest)
        total += LQ.gamma**t * reward
    assert (total[1:] < total[0]).all()  # from each of 40 starts


def test_riccati_is_for_the_lq_task_only():
    with pytest.raises(BcrlError, match="target"):
        riccati.gain(LinearSystem())


def test_the_last_gain_is_riccatis_within_a_hundredth():
    *_, final = moments(range(10))
    best = riccati.gain(LQ)
    off = gains(final, 10) - best
    assert (np.linalg.norm(off, axis=(1, 2)) / np.linalg.norm(best)).max() < 0.01
    # Worst entry, relative to the largest: half of the optimal entries are zero.
    assert np.abs(off).max() / np.abs(best).max() < 0.01
    own = np.abs(best) > 1.0
    assert (np.abs(off[:, own]) / np.abs(best[own])).max() < 0.01
    assert final.failed == {}


@pytest.mark.parametrize("kind", FEATURES)
def test_the_papers_readings_learn_it_too(kind):
    learner = LSPI(noise_std=0.1**0.5, features=kind, drop_last=False)
    env = replace(LQ, preset="paper")
    # Half the force: four iterations leave 5 %.
    learner = replace(learner, iterations=8, steps=4000)
    *_, final = moments(range(3), learner, env)
    best = riccati.gain(env)
    off = np.linalg.norm(gains(final, 3) - best, axis=(1, 2)) / np.linalg.norm(best)
    assert off.max() < 0.01


def test_learning_pays_and_counts_its_steps():
    seen = [(m, evaluate(m, (0, 1))) for m in _evaluated((0, 1), before=70)]
    assert [m.count for m, _ in seen] == [70, 570, 1070, 1570, 2070]
    assert [m.last_of_stage for m, _ in seen] == [False] * 4 + [True]
    assert LSPI().length == 2000
    for s in range(2):
        first, *_, final = (rows[s]["discounted_return"] for _, rows in seen)
        assert first < -3000.0 < -1500.0 < final  # nothing done: 48 a step and more
        assert final == seen[-1][1][s]["greedy_discounted_return"]  # without noise


def _evaluated(seeds, before):
    learner = LSPI()
    yield from learner.learn(
        staged(learner, LQ, before=before), StageInit(), team(*seeds)
    )


def products(z):
    return [z[i] * z[j] for i in range(len(z)) for j in range(i, len(z))]


def phi(z, kind):
    return products(z) if kind == "products" else [*z, *products(z)]


@pytest.mark.parametrize("kind", FEATURES)
def test_quadratic_values_are_weights_times_features(kind):
    rng = np.random.default_rng(1)
    n = 21 if kind == "products" else 27
    theta, states = rng.standard_normal((3, n)), rng.standard_normal((3, 7, 4))
    q = Quadratic.from_weights(theta, kind, 6, LQ.actions)
    stacked, listed = q(states, 8), q(list(states[:, :5]), 8)
    for s, i, a in np.ndindex(3, 7, 8):
        z = [*states[s, i], *LQ.actions[a]]
        expected = sum(w * f for w, f in zip(theta[s], phi(z, kind), strict=True))
        assert stacked[s, i, a] == pytest.approx(expected, rel=1e-10, abs=1e-10)
        if i < 5:
            assert listed[s][i, a] == pytest.approx(expected, rel=1e-10, abs=1e-10)
    assert np.array_equal(q.matrix, q.matrix.transpose(0, 2, 1))


def transitions(n=80, idle=()):
    """Random z, z' and rewards; the components in `idle` are always zero."""
    rng = np.random.default_rng(2)
    z, after = rng.standard_normal((2, n, 6))
    z[:, idle], after[:, idle] = 0.0, 0.0
    return z, after, rng.standard_normal(n)


@pytest.mark.parametrize("kind", FEATURES)
@pytest.mark.parametrize("idle", [(), (2,), (2, 3, 5)])
def test_lstdq_solves_its_equations_by_the_pseudo_inverse_if_need_be(kind, idle):
    z, after, reward = transitions(idle=idle)
    n = 21 if kind == "products" else 27
    a, b = np.zeros((n, n)), np.zeros(n)
    for i in range(len(z)):
        now, then = np.array(phi(z[i], kind)), np.array(phi(after[i], kind))
        a += np.outer(now, now - 0.9 * then)
        b += now * reward[i]
    shortest, _, rank, _ = scipy.linalg.lstsq(a, b, cond=1e-10)
    assert (rank == n) == (not idle)
    found = lstdq(z, after, reward, 0.9, LSPI(features=kind))
    assert np.allclose(found, shortest, rtol=1e-6, atol=1e-8)


def test_lstdq_with_too_few_transitions_is_the_shortest_solution():
    z, after, reward = transitions(n=12)  # of 21 unknowns
    found = lstdq(z, after, reward, 0.9, LSPI())
    now = np.array([phi(x, "products") for x in z])
    a = now.T @ (now - 0.9 * np.array([phi(x, "products") for x in after]))
    shortest = scipy.linalg.lstsq(a, now.T @ reward, cond=1e-10)[0]
    assert np.allclose(found, shortest, rtol=1e-5, atol=1e-6)


def good_matrix():
    """A Q with K = −diag-like gains: force i = −2 position − 1 velocity."""
    matrix = -np.eye(6)
    for i in range(2):
        matrix[4 + i, 2 * i], matrix[4 + i, 2 * i + 1] = -2.0, -1.0
    return matrix


def test_the_improved_gain_by_hand():
    assert improved(good_matrix(), LQ).tolist() == [[-2, -1, 0, 0], [0, 0, -2, -1]]


@pytest.mark.parametrize(
    ("where", "value"),
    [
        ((4, 0), 1e-6),  # pushes along x
        ((5, 2), 1e-6),  # along y
        ((slice(4, 6), slice(4, 6)), 1.0),  # singular
        ((4, 4), np.nan),
        ((4, 1), np.nan),
        ((4, 0), -np.inf),
    ],
)
def test_a_gain_that_pushes_away_or_is_none_is_refused(where, value):
    matrix = good_matrix()
    matrix[where] = value
    assert improved(matrix, LQ) is None


@pytest.mark.parametrize("returned", [None, -1e5])
def test_a_seed_that_fails_is_named_and_the_others_are_as_without_it(
    monkeypatch, returned
):
    """Seed 1 of three finds no gain in iteration 2, or one that explodes later."""
    expected, calls = moments(), []

    def faulty(matrix, env):
        calls.append(env)
        if len(calls) != 3 + 2:
            return improved(matrix, env)
        return returned if returned is None else np.full((2, 4), returned)

    monkeypatch.setattr(lspi, "improved", faulty)
    with np.errstate(all="ignore"):
        found = moments()
    first = 2 if returned is None else 3
    for i, (one, other) in enumerate(zip(found, expected, strict=True)):
        assert list(one.failed) == ([1] if i >= first else [])
        for s in (0, 2):
            assert np.array_equal(gains(one, 3)[s], gains(other, 3)[s])
            if i:
                matrices = (x.learned.q.matrix[s] for x in (one, other))
                assert np.array_equal(*matrices)
    assert f"iteration {first}" in found[-1].failed[1]


def test_without_exploration_every_seed_fails():
    final = moments((0, 1), LSPI(noise_std=0.0))[-1]
    assert list(final.failed) == [0, 1]


@pytest.mark.parametrize("drop", [True, False])
def test_what_an_iteration_collects(drop):
    learner, n = LSPI(drop_last=drop), 495 if drop else 500
    k = np.stack([riccati.gain(LQ) / 3, riccati.gain(LQ) / 2])
    z, after, reward = learner._collect(staged(learner, LQ), k, 1, team(5, 6))
    assert z.shape == after.shape == (2, n, 6) and reward.shape == (2, n)
    noise = z[..., 4:] - np.einsum("skd,snd->snk", k, z[..., :4])
    assert noise.std() == pytest.approx(0.1, rel=0.05) and abs(noise.mean()) < 0.01
    assert np.allclose(after[..., 4:], np.einsum("skd,snd->snk", k, after[..., :4]))
    cost = ([3, 1, 3, 1] * after[..., :4] ** 2).sum(-1) + 0.1 * (z[..., 4:] ** 2).sum(
        -1
    )
    assert np.allclose(reward, -cost, rtol=1e-12)
    episodes = z.reshape(2, 5, n // 5, 6), after.reshape(2, 5, n // 5, 6)
    assert np.array_equal(episodes[0][:, :, 1:, :4], episodes[1][:, :, :-1, :4])
    assert (np.abs(episodes[0][:, :, 0, :4] - [-4, 0, 0, 0]) <= 0.3).all()
    again = learner._collect(staged(learner, LQ), k, 2, team(5, 6))[0]
    assert not np.array_equal(z[:, 0], again[:, 0])  # its own data, every iteration
    assert stream(5, "data", 1, 1).random() != stream(5, "data", 1, 2).random()


def test_a_seed_alone_is_the_same_among_others():
    for one, among in zip(moments((3,)), moments(range(5)), strict=True):
        assert np.array_equal(gains(one, 1)[0], gains(among, 5)[3])
        if one.count:
            assert np.array_equal(one.learned.q.matrix[0], among.learned.q.matrix[3])
            at = np.random.default_rng(0).standard_normal((5, 1, 4))
            values = one.learned.q(at[3:4], 8), among.learned.q(at, 8)
            assert np.array_equal(values[0][0], values[1][3])


def test_the_horizon_is_the_environments():
    short = replace(LQ, horizon=50)
    learner = LSPI(iterations=2, steps=300)
    *_, final = learner.learn(staged(learner, short), StageInit(), team(0))
    assert learner.episodes_per_iteration(short) == 3
    assert final.count == learner.length == 300
    for wrong in (LQ, replace(LQ, horizon=200)):  # 2 x 100 does not divide 300
        with pytest.raises(ConfigError, match=r"algorithm\.steps=300"):
            list(learner.learn(staged(learner, wrong), StageInit(), team(0)))


def test_positions_are_where_the_environment_says():
    class Swapped(LinearSystem):
        positions = (1, 3)

    matrix = good_matrix()
    matrix[4, 1] = matrix[1, 4] = -matrix[4, 1]  # the gain on a velocity changes sign
    assert improved(matrix, LQ) is not None
    assert improved(matrix, Swapped("lq")) is None
    assert improved(good_matrix(), Swapped("lq")) is not None
