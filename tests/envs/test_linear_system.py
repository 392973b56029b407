"""The linear system's two tasks, recomputed number by number from the specification."""

import math
import statistics

import numpy as np
import pytest

from bcrl.envs.linear_system import LinearSystem

#: (preset, task): gain, friction, half-widths of the start's box
SPECIFIED = {
    ("released", "lq"): (2.0, 0.1, (0.3, 0.3, 0.3, 0.3)),
    ("released", "target"): (2.0, 1.0, (1e-3, 0.1, 0.4, 0.1)),
    ("paper", "lq"): (1.0, 0.1, (0.0, 0.3, 0.0, 0.3)),
    ("paper", "target"): (1.0, 0.1, (0.0, 0.1, 0.4, 0.1)),
}
ALL = pytest.mark.parametrize(("preset", "task"), list(SPECIFIED))


def env_of(preset, task):
    return LinearSystem(task, preset=preset)


def start_by_hand(preset, task, u):
    _, _, box = SPECIFIED[preset, task]
    centre = (-4.0, 0.0, 0.0, 0.0)
    return [c - h + 2.0 * h * v for c, h, v in zip(centre, box, u, strict=True)]


def step_by_hand(preset, task, state, force, u):
    """One step in plain floats: next state, reward, absorbing, what happened."""
    gain, friction, _ = SPECIFIED[preset, task]
    x, vx, y, vy = state
    z = [statistics.NormalDist().inv_cdf(v) * 1e-5 for v in u[:4]]
    drift = -0.5 if task == "target" else 0.0
    new = [
        x + 0.05 * (vx + drift + z[0]),
        vx + 0.05 * (-friction * vx + gain * force[0] + z[1]),
        y + 0.05 * (vy + z[2]),
        vy + 0.05 * (-friction * vy + gain * force[1] + z[3]),
    ]
    if task == "lq":
        cost = sum(w * s * s for w, s in zip((3, 1, 3, 1), new, strict=True))
        cost += 0.1 * (force[0] ** 2 + force[1] ** 2)
        return new, -cost, False, "lq"
    event = "free"
    for wall, outside in ((-5.0, new[0] < -5.0), (1.0, new[0] > 1.0)):
        if outside:
            event = f"wall {wall}"
            share = (wall - x) / (new[0] - x)
            at = [a + share * (b - a) for a, b in zip(state, new, strict=True)]
            at[1] = -at[1]
            rest = 0.05 * (1.0 - share)
            slope = (at[1], -friction * at[1], at[3], -friction * at[3])
            new = [a + rest * b for a, b in zip(at, slope, strict=True)]
    if abs(new[2]) > 0.5:
        new, event = start_by_hand(preset, task, u[4:]), "reset"
    success = math.hypot(new[0], new[2]) < 0.2
    return new, 0.0 if success else -1.0, success, "goal" if success else event


def anywhere(n, seed=0):
    """Random states between the walls, fast ones too, many where something happens."""
    rng = np.random.default_rng(seed)
    state = rng.standard_normal((n, 4)) * [0.0, 4.0, 0.0, 2.0]
    state[:, 0] = rng.choice([-4.95, -2.0, 0.0, 0.9], n) + rng.uniform(-0.05, 0.1, n)
    state[:, 2] = rng.choice([-0.45, 0.0, 0.45], n) + rng.uniform(-0.05, 0.05, n)
    return state, rng.integers(8, size=n), rng.random((n, 8))


@ALL
def test_a_push_is_the_specifications_number_by_number(preset, task):
    env, (state, _, noise) = env_of(preset, task), anywhere(3000)
    force = np.random.default_rng(2).standard_normal((3000, 2))
    after, reward, absorbing = env.push(state, force, noise)
    events = set()
    for i in range(3000):
        lane = (x[i].tolist() for x in (state, force, noise))
        found = step_by_hand(preset, task, *lane)
        assert after[i].tolist() == pytest.approx(found[0], abs=1e-12)
        assert reward[i] == pytest.approx(found[1], rel=1e-12)
        assert absorbing[i] == found[2]
        events.add(found[3])
    everything = {"free", "wall -5.0", "wall 1.0", "reset", "goal"}
    assert events == ({"lq"} if task == "lq" else everything)


def test_a_step_is_a_push_of_unit_length():
    env, (state, action, noise) = LinearSystem(), anywhere(200, seed=1)
    pushed = env.push(state, env.actions[action], noise)
    np.testing.assert_equal(env.step(state, action, noise), pushed)
    turns = np.radians([0, 90, 180, 270, 45, -45, 135, 225])
    assert np.allclose(env.actions, np.stack([np.cos(turns), np.sin(turns)], -1))


@ALL
def test_the_start_box(preset, task):
    u = np.random.default_rng(3).random((500, 4))
    expected = [start_by_hand(preset, task, each) for each in u]
    assert np.allclose(env_of(preset, task).initial(u), expected, atol=1e-14)


def test_who_leaves_the_path_starts_anew_and_before_reset_knows_where_from():
    env, (state, action, noise) = LinearSystem(), anywhere(3000, seed=4)
    after, _, absorbing = env.step(state, action, noise)
    left = env.before_reset(state, action, noise)
    off = np.abs(left[:, 2]) > 0.5
    assert 100 < off.sum() < 2900 and not absorbing[off].any()
    assert np.array_equal(after[off], env.initial(noise[off, 4:]))
    assert np.array_equal(after[~off], left[~off])


@ALL
@pytest.mark.parametrize("u", [0.0, 1.0 - 2.0**-53])
def test_the_rarest_uniforms_give_finite_noise(preset, task, u):
    state, action, _ = anywhere(4)
    after, reward, _ = env_of(preset, task).step(state, action, np.full((4, 8), u))
    assert np.isfinite(after).all() and np.isfinite(reward).all()


@pytest.mark.parametrize("preset", ["released", "paper"])
def test_the_lq_matrices_are_those_of_a_step(preset):
    env, rng = env_of(preset, "lq"), np.random.default_rng(9)
    a, b, q, r = env.linear_quadratic
    assert env_of(preset, "target").linear_quadratic is None
    for _ in range(20):
        s, f = rng.standard_normal(4), rng.standard_normal(2)
        after, reward, _ = env.push(s, f, np.full(8, 0.5))
        assert np.allclose(after, a @ s + b @ f, atol=1e-14)
        assert reward == pytest.approx(-after @ q @ after - f @ r @ f, rel=1e-12)


@ALL
def test_it_is_evaluated_from_the_targets_start_box(preset, task):
    found = env_of(preset, task).evaluation_states()
    assert found.shape == (17, 4) and found[0].tolist() == [-4.0, 0.0, 0.0, 0.0]
    half = 0.5 * np.array(SPECIFIED[preset, "target"][2])
    assert np.allclose(np.abs(found[1:] - found[0]), half, atol=1e-15)
