"""LSPI against the Riccati equation, and its parts against plain linear algebra."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg

from bcrl.envs.linear_system import LinearSystem
from bcrl.errors import BcrlError, ConfigError
from bcrl.evaluation.step_metrics import evaluate
from bcrl.learning import lspi
from bcrl.learning.lspi import LSPI, improved, lstdq
from bcrl.learning.transfer import StageInit
from bcrl.q.quadratic import FEATURES, Quadratic
from tests.toys import staged, team

LQ = LinearSystem("lq", horizon=100)


def riccati_gain(env):
    """K (k, d) of the optimal a = K s: the Riccati equation's fixed point, iterated."""
    a, b = np.eye(4), np.zeros((4, 2))
    a[0, 1] = a[2, 3] = 0.05
    a[1, 1] = a[3, 3] = 1.0 - 0.05 * 0.1
    b[1, 0] = b[3, 1] = 0.05 * (2.0 if env.preset == "released" else 1.0)
    value, r, cost = np.zeros((4, 4)), 0.1 * np.eye(2), np.diag([3.0, 1.0, 3.0, 1.0])
    for _ in range(4000):  # cost-to-go sᵀ V s; the new state is paid for
        m = cost + env.gamma * value
        k = -np.linalg.solve(r + b.T @ m @ b, b.T @ m @ a)
        value = (a + b @ k).T @ m @ (a + b @ k) + k.T @ r @ k
    return k


def iterations(seeds=(0, 1, 2), learner=None, env=LQ, before=0):
    learner = learner or LSPI()
    stage = staged(learner, env, before=before)
    return list(learner.learn(stage, StageInit(), team(*seeds)))


def gains(snapshot, n):
    """What each seed's policy does at the unit vectors, K (S, 2, 4)."""
    at = np.tile(np.eye(4), (n, 1, 1))
    force = snapshot.policy(at, np.full((n, 4, 10), 0.5), np.ones((n, 4), bool))
    return force.transpose(0, 2, 1)


def test_the_last_gain_is_riccatis_within_a_hundredth():
    *_, final = iterations(range(10))
    best = riccati_gain(LQ)
    off = gains(final, 10) - best
    # Worst entry, relative to the largest: half of the optimal entries are zero.
    assert np.abs(off).max() / np.abs(best).max() < 0.01
    assert final.failed == {}


@pytest.mark.parametrize("kind", FEATURES)
def test_the_papers_readings_learn_it_too(kind):
    # Half the force: four iterations leave 5 %.
    learner = LSPI(8, 4000, noise_std=0.1**0.5, features=kind, drop_last=False)
    env = replace(LQ, preset="paper")
    *_, final = iterations(range(3), learner, env)
    best = riccati_gain(env)
    off = np.linalg.norm(gains(final, 3) - best, axis=(1, 2)) / np.linalg.norm(best)
    assert off.max() < 0.01


def test_learning_pays_and_counts_its_steps():
    seen = [(x, evaluate(x, (0, 1))[0]) for x in iterations((0, 1), before=70)]
    assert [x.count for x, _ in seen] == [70, 570, 1070, 1570, 2070]
    assert [x.last_of_stage for x, _ in seen] == [False] * 4 + [True]
    for s in range(2):
        first, *_, final = (rows[s]["discounted_return"] for _, rows in seen)
        assert first < -3000.0 < -1500.0 < final  # no force costs 48 per step and more
        assert final == seen[-1][1][s]["greedy_discounted_return"]  # without noise


def phi(z, kind):
    products = [z[i] * z[j] for i in range(len(z)) for j in range(i, len(z))]
    return products if kind == "products" else [*z, *products]


@pytest.mark.parametrize("kind", FEATURES)
def test_quadratic_values_are_weights_times_features(kind):
    rng = np.random.default_rng(1)
    n = 21 if kind == "products" else 27
    theta, states = rng.standard_normal((3, n)), rng.standard_normal((3, 7, 4))
    q = Quadratic.from_weights(theta, kind, 6, LQ.actions)
    stacked, listed = q(states, 8), q(list(states), 8)
    for s, i, a in np.ndindex(3, 7, 8):
        z = [*states[s, i], *LQ.actions[a]]
        expected = sum(w * f for w, f in zip(theta[s], phi(z, kind), strict=True))
        assert stacked[s, i, a] == pytest.approx(expected, rel=1e-10, abs=1e-10)
        assert listed[s][i, a] == pytest.approx(expected, rel=1e-10, abs=1e-10)
    for wrong in (states[..., :3], states[:2], [*states, states[0]]):
        with pytest.raises(BcrlError, match=r"4 entries.* 3;|3 seeds.* [24];"):
            q(wrong, 8)


@pytest.mark.parametrize("kind", FEATURES)
@pytest.mark.parametrize(("n", "idle"), [(80, ()), (80, (2, 3, 5)), (12, ())])
def test_lstdq_solves_its_equations_by_the_pseudo_inverse_if_need_be(kind, n, idle):
    """Singular if some components are always zero, or for fewer rows than features."""
    rng = np.random.default_rng(2)
    z, after = rng.standard_normal((2, n, 6))
    z[:, idle], after[:, idle] = 0.0, 0.0
    reward = rng.standard_normal(n)
    now = np.array([phi(x, kind) for x in z])
    a = now.T @ (now - 0.9 * np.array([phi(x, kind) for x in after]))
    shortest, _, rank, _ = scipy.linalg.lstsq(a, now.T @ reward, cond=1e-10)
    assert (rank == len(a)) == (n == 80 and not idle)
    found = lstdq(z, after, reward, 0.9, kind)
    assert np.allclose(found, shortest, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("where", "value"),
    [
        ((4, 0), 1e-6),  # pushes along x
        ((5, 2), 1e-6),  # along y
        ((slice(4, 6), slice(4, 6)), 1.0),  # singular
        ((4, 1), np.nan),
        ((4, 0), -np.inf),
    ],
)
def test_a_gain_that_pushes_away_or_is_not_finite_is_rejected(where, value):
    matrix = -np.eye(6)  # of a Q whose force i is −2 position − 1 velocity
    matrix[[4, 4, 5, 5], range(4)] = [-2.0, -1.0, -2.0, -1.0]
    assert improved(matrix, LQ).tolist() == [[-2, -1, 0, 0], [0, 0, -2, -1]]
    matrix[where] = value
    assert improved(matrix, LQ) is None


@pytest.mark.parametrize("returned", [None, -1e5])
def test_a_seed_that_fails_is_named_and_the_others_are_as_without_it(
    monkeypatch, returned
):
    """Seed 1 of three finds no gain in iteration 2, or one that explodes later."""
    expected, calls = iterations(), []

    def faulty(matrix, env):
        calls.append(env)
        if len(calls) != 3 + 2:
            return improved(matrix, env)
        return returned if returned is None else np.full((2, 4), returned)

    monkeypatch.setattr(lspi, "improved", faulty)
    with np.errstate(all="ignore"):
        found = iterations()
    first = 2 if returned is None else 3
    for i, (one, other) in enumerate(zip(found, expected, strict=True)):
        assert list(one.failed) == ([1] if i >= first else [])
        for s in (0, 2):
            assert np.array_equal(gains(one, 3)[s], gains(other, 3)[s])
    assert f"iteration {first}" in found[-1].failed[1]


@pytest.mark.parametrize("drop", [True, False])
def test_what_an_iteration_collects(drop):
    learner, n = LSPI(drop_last=drop), 495 if drop else 500
    k = np.stack([riccati_gain(LQ) / 3, riccati_gain(LQ) / 2])
    z, after, reward = learner._collect(staged(learner, LQ), k, 1, team(5, 6))
    assert z.shape == after.shape == (2, n, 6) and reward.shape == (2, n)
    force, next_force = (np.einsum("skd,snd->snk", k, x[..., :4]) for x in (z, after))
    noise = z[..., 4:] - force
    assert noise.std() == pytest.approx(0.1, rel=0.05) and abs(noise.mean()) < 0.01
    assert np.allclose(after[..., 4:], next_force)
    state_cost = ([3, 1, 3, 1] * after[..., :4] ** 2).sum(-1)
    cost = state_cost + 0.1 * (z[..., 4:] ** 2).sum(-1)
    assert np.allclose(reward, -cost, rtol=1e-12)
    state, next_state = (x.reshape(2, 5, n // 5, 6)[..., :4] for x in (z, after))
    assert np.array_equal(state[:, :, 1:], next_state[:, :, :-1])
    assert (np.abs(state[:, :, 0] - [-4, 0, 0, 0]) <= 0.3).all()
    again = learner._collect(staged(learner, LQ), k, 2, team(5, 6))[0]
    assert not np.array_equal(z[:, 0], again[:, 0])  # its own data, every iteration


def test_steps_that_are_not_whole_episodes_are_rejected():
    learner = LSPI(iterations=2, steps=300)
    assert learner.episodes_per_iteration(replace(LQ, horizon=50)) == 3
    with pytest.raises(ConfigError, match=r"algorithm\.steps=300"):
        iterations((0,), learner, LQ)  # 2 x 100 does not divide 300
