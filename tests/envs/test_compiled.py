"""A user's step of one state becomes a step of arrays."""

import math
import pickle

import cloudpickle
import numpy as np
import pytest

from bcrl.envs.compiled import compiled_step


@compiled_step
def drift(state, action, noise, pushes, wall):
    x, v = state
    v = v + pushes[action] + 0.1 * noise[0]
    for _ in range(3):
        x = x + v / 3.0
        if x > wall:
            x, v = wall, 0.0
    return (x, v), -math.fabs(x), x < -wall


def drift_of_arrays(state, action, noise, pushes, wall):
    x, v = np.moveaxis(state, -1, 0)
    v = v + np.array(pushes)[action] + 0.1 * noise[..., 0]
    for _ in range(3):
        x = x + v / 3.0
        x, v = np.where(x > wall, wall, x), np.where(x > wall, 0.0, v)
    return np.stack([x, v], -1), -np.abs(x), x < -wall


def test_it_is_the_step_of_arrays_for_any_leading_axes():
    rng = np.random.default_rng(0)
    state, action = rng.normal(size=(5, 4, 2)), rng.integers(3, size=(5, 4))
    given = state, action, rng.random((5, 4, 1)), (-1.0, 0.0, 1.0), 0.7
    wide = state[:, :1], np.arange(3), given[2][:, :1], *given[3:]
    one = state[0, 0], action[0, 0], given[2][0, 0], *given[3:]
    kept = state.copy()
    for arguments in (given, wide, one, (state[:, ::2].astype("f4"), 1, *wide[2:])):
        found, expected = (f(*arguments) for f in (drift, drift_of_arrays))
        for a, b in zip(found, expected, strict=True):
            assert a.shape == b.shape and a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)
    assert np.array_equal(state, kept)


def test_it_can_be_sent_to_another_process():
    given = np.zeros((1, 2)), np.zeros(1, int), np.zeros((1, 1)), (-1.0,), 0.7
    sent = pickle.loads(cloudpickle.dumps({"step": drift}))["step"]
    here = pickle.loads(pickle.dumps(sent))  # by its name
    for found in (sent, here):
        for a, b in zip(found(*given), drift(*given), strict=True):
            assert (a == b).all()


def test_a_step_that_numba_cannot_compile_is_explained():
    @compiled_step
    def wrong(state, action, noise):
        return (state[0] + unknown,), 0.0, False  # noqa: F821

    with pytest.raises(TypeError, match=r"wrong: NameError.*unknown.*test_compiled"):
        wrong(np.zeros((2, 1)), np.zeros(2, int), None)
