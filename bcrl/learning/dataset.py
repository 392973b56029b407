"""Datasets of transitions over distinct points, as fitted Q-iteration needs them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bcrl.common.serialization import storable
from bcrl.envs import Env, is_finite
from bcrl.learning import Booleans, Floats, Integers
from bcrl.learning.rollout import Episodes, transition_tables


@storable
@dataclass(frozen=True)
class Dataset:
    """One seed's transitions; states are indices of `points`.

    Q is evaluated once per point. Regressors see float32, so states that agree in
    float32 are one point. A finite environment's rows are distinct and have counts.
    """

    points: NDArray[np.float32]  # (P, d) distinct states, probed ones included
    probe: Integers  # (n_probe,) the probed states among `points`
    state: Integers  # (n,)
    action: Integers  # (n,)
    reward: Floats  # (n,)
    next_state: Integers  # (n,)
    absorbing: Booleans  # (n,)
    multiplicity: NDArray[np.int64]  # (n,)
    by_action: list[tuple[Integers, Integers]]  # its rows; the points without one


def build(env: Env, episodes: Episodes, seed: int, probe: Floats) -> Dataset:
    """The dataset of the seed with index `seed`; `probe` (n, d) is among its points."""
    seen = np.arange(episodes.reward.shape[-1]) < episodes.length[seed][:, None]
    before = episodes.state[seed, :, :-1][seen]  # (n, d)
    action = episodes.action[seed][seen]
    if is_finite(env):
        points, probed = env.states().astype(np.float32), env.index(probe)
        pairs = env.index(before) * env.n_actions + action
        pairs, count = np.unique(pairs, return_counts=True)
        state, action = at = np.divmod(pairs, env.n_actions)
        to, pays, ends = transition_tables(env)
        next_state, reward, absorbing = to[at], pays[at], ends[at]
    else:
        after, n = episodes.state[seed, :, 1:][seen], len(before)
        every = np.concatenate([before, after, probe]).astype(np.float32)
        points, label = np.unique(every, axis=0, return_inverse=True)
        state, next_state, probed = np.split(label.reshape(-1), [n, 2 * n])
        reward, absorbing = episodes.reward[seed][seen], episodes.absorbing[seed][seen]
        count = np.ones(len(state), np.int64)  # a continuum seldom repeats
    by_action = []
    for a in range(env.n_actions):
        own = np.flatnonzero(action == a)
        others = np.setdiff1d(np.arange(len(points)), state[own])
        by_action.append((own, others))
    return Dataset(
        points, probed, state, action, reward, next_state, absorbing, count, by_action
    )
