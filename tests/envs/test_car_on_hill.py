"""The car on the hill against physics computed in other ways."""

import numpy as np
import pytest
from scipy.integrate import odeint

from bcrl.envs.car_on_hill import CarOnHill


def motion(y, _, force, mass):
    """The equations of motion, as the paper writes them."""
    p, v = y
    slope = 2 * p + 1 if p < 0 else (1 + 5 * p * p) ** -1.5
    bend = 2.0 if p < 0 else -15 * p * (1 + 5 * p * p) ** -2.5
    push = force - 9.81 * mass * slope - v * v * mass * slope * bend
    return [v, push / (mass * (1 + slope * slope))]


def scattered(n, seed):
    """Thirds of n states anywhere, crossing p = 0 and grazing it; and actions."""
    rng = np.random.default_rng(seed)
    state = rng.uniform((-1, -3), (1, 3), (n, 2))
    _, crossing, grazing = np.split(state, 3)  # views
    crossing[:, 0] = -crossing[:, 1] * rng.uniform(0, 0.1, len(crossing))
    grazing[:, 1] = rng.uniform(-0.1, 0.8, len(grazing))
    grazing[:, 0] = -grazing[:, 1] * rng.uniform(0, 0.07, len(grazing))
    return state, rng.integers(0, 2, n)


@pytest.mark.parametrize("mass", (0.8, 1.0, 1.2))
def test_step_agrees_with_odeint(mass):
    state, action = scattered(600, seed=1)
    after, _, _ = CarOnHill(mass=mass).step(state, action)
    forces = np.where(action == 1, 4.0, -4.0)
    tight = {"rtol": 1e-11, "atol": 1e-11}
    expected = [
        odeint(motion, s, [0, 0.1], args=(u, mass), **tight)[1]
        for s, u in zip(state, forces, strict=True)
    ]
    assert (np.sign(state[:, 0]) != np.sign(after[:, 0])).sum() > 120  # many crossings
    assert abs(after - expected).max() < 2e-7


def test_reward_and_absorption_follow_the_bounds():
    state = np.array([[0.95, 1.0], [0.95, 2.99], [-0.95, -1.0], [-0.5, 0.0]])
    after, reward, absorbing = CarOnHill().step(state, np.array([1, 1, 0, 0]))
    p, v = after.T
    lost = (p < -1) | (abs(v) > 3)
    np.testing.assert_array_equal(reward, np.where(lost, -1, np.where(p > 1, 1, 0)))
    np.testing.assert_array_equal(absorbing, reward != 0)
    assert reward[0] == 1.0 and set(reward[2:]) == {-1.0, 0.0}


def test_states_once_left_stay_without_warnings():
    outside = np.array([[1.1, 0.0], [-1.5, 0.0], [0.0, 3.1], [np.nan, 0.0], [1e300, 9]])
    after, reward, absorbing = CarOnHill().step(outside, np.ones(5, dtype=int))
    np.testing.assert_array_equal(after, outside)
    assert absorbing.all() and not reward.any()


def test_shapes_broadcast_and_inputs_are_left_alone():
    env = CarOnHill()
    state = env.evaluation_states()
    after, reward, absorbing = env.step(state[:, None], np.arange(2))
    assert after.shape == (100, 2, 2) and reward.shape == absorbing.shape == (100, 2)
    strided = env.step(np.asfortranarray(state), np.ones(100, np.int8))
    np.testing.assert_array_equal(after[:, 1], strided[0])
    np.testing.assert_array_equal(state, env.evaluation_states())
    with pytest.raises(IndexError):
        env.step(state[0], np.array(2))


def test_start_and_grid():
    env = CarOnHill()
    assert env.initial(np.zeros((3, 4, 0)))[2, 3].tolist() == [-0.5, 0.0]
    grid = env.evaluation_states()
    assert grid.shape == (100, 2) and grid[[0, -1]].tolist() == [[-1, -3], [1, 3]]
