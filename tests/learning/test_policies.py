"""Greedy choice and its ties."""

import numpy as np

from bcrl.learning.policies import greedy, uniform


def test_greedy_takes_the_maximum():
    q = np.array([[0.0, 2.0, 1.0], [3.0, -1.0, 2.0]])
    assert greedy(q, np.array([0.99, 0.0])).tolist() == [1, 0]


def test_ties_are_broken_uniformly_among_the_best():
    q = np.tile([5.0, 1.0, 5.0, 5.0], (9000, 1))
    u = (np.arange(9000) + 0.5) / 9000
    counts = np.bincount(greedy(q, u), minlength=4)
    assert counts.tolist() == [3000, 0, 3000, 3000]


def test_uniform_actions_cover_all_and_only_actions():
    actions = uniform(4, np.array([0.0, 0.2499, 0.25, 0.75, np.nextafter(1, 0)]))
    assert actions.tolist() == [0, 0, 1, 3, 3]
