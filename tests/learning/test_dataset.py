"""Datasets keep every transition, once, with its count."""

import numpy as np
import pytest

from bcrl.common.seeding import stream
from bcrl.learning import dataset
from bcrl.learning.rollout import rollout, starts_and_draws
from bcrl.q.functions import ZERO
from tests.toys import Corridor, OpenCorridor


@pytest.mark.parametrize("env", [Corridor(), OpenCorridor()])
def test_the_dataset_is_the_episodes_with_repetitions_counted(env):
    start, u = starts_and_draws([stream(0, "data")], env, 40)
    played = rollout(env, ZERO, start, u, 1.0)
    probe = np.array([[2.0], [0.0]])
    d = dataset.build(env, played, 0, probe)

    def rows(*columns):
        return sorted(
            zip(*(np.asarray(c).ravel().tolist() for c in columns), strict=True)
        )

    kept = np.arange(env.horizon) < played.length[0][:, None]
    state, outcomes = played.state[0], (played.action, played.reward, played.absorbing)
    seen = (state[:, :-1], state[:, 1:], *(x[0] for x in outcomes))
    expected = rows(*(x[kept] for x in seen))
    again = np.repeat(np.arange(len(d.state)), d.multiplicity)
    stored = (d.points[d.state], d.points[d.next_state])
    stored += (d.action, d.reward, d.absorbing)
    assert rows(*(x[again] for x in stored)) == expected
    if env.finite:
        assert len(d.state) <= 10 < len(expected)  # the corridor repeats itself
    assert np.array_equal(d.points[d.probe], probe)
    for a, (own, others) in enumerate(d.by_action):
        assert own.tolist() == np.flatnonzero(d.action == a).tolist()
        asked = [*set(d.state[own].tolist()), *others.tolist()]
        assert sorted(asked) == list(range(len(d.points)))
