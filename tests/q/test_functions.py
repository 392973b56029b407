"""Shaped and memoized Q-functions query what they wrap only once."""

import numpy as np
import pytest

from bcrl.learning.transfer import StageInit
from bcrl.q.functions import ZERO, Shaped


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
