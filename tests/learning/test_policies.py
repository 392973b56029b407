"""The residual policy's table of actions against a search of all actions."""

import math

import numpy as np

from bcrl.envs.linear_system import LinearSystem
from bcrl.learning.policies import combined_actions


def by_brute_force(actions, prior, own):
    both = actions[prior] + actions[own]
    if math.hypot(*both) < 1e-6:
        return own
    rank = [[round(math.dist(a, x), 6) for x in (both, actions[own])] for a in actions]
    assert rank.count(min(rank)) == 1  # both rules together leave no choice
    return rank.index(min(rank))


def test_the_residual_policys_table_is_a_brute_force_searchs():
    actions = LinearSystem().actions
    table = combined_actions(actions)
    for prior, own in np.ndindex(8, 8):
        assert table[prior, own] == by_brute_force(actions, prior, own)
