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
class ActionRows:
    """The regression problem of one action: its n rows, and all other points."""

    rows: Integers  # (n,) rows of the dataset
    x: NDArray[np.float32]  # (n, d) their states
    multiplicity: NDArray[np.int64]  # (n,) how often each row was seen
    queries: NDArray[np.float32]  # (m, d) the points without a row
    query_points: Integers  # (m,) their indices in the dataset's points


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
    by_action: tuple[ActionRows, ...]


def build(env: Env, episodes: Episodes, seed: int, probe: NDArray) -> Dataset:
    """The dataset of the seed with index `seed`, with `probe` (n, d) among its points.

    Shapes as in `Dataset` and `Episodes`.
    """
    seen = np.arange(episodes.reward.shape[-1]) < episodes.length[seed][:, None]
    before = episodes.state[seed, :, :-1][seen]  # (n, d)
    action = episodes.action[seed][seen]
    if is_finite(env):
        points, probed = env.states().astype(np.float32), env.index(probe)
        counts = np.bincount(env.index(before) * env.n_actions + action)
        pairs = np.flatnonzero(counts)
        count = counts[pairs]
        state, action = np.divmod(pairs, env.n_actions)
        to, pays, ends = transition_tables(env)
        next_state, reward = to[state, action], pays[state, action]
        absorbing = ends[state, action]
    else:
        after = episodes.state[seed, :, 1:][seen]
        every = np.concatenate([before, after, probe]).astype(np.float32)
        points, label = np.unique(every, axis=0, return_inverse=True)
        label = label.reshape(-1)
        state, next_state, probed = np.split(label, [len(before), 2 * len(before)])
        reward = episodes.reward[seed][seen]
        absorbing = episodes.absorbing[seed][seen]
        count = np.ones(len(state), np.int64)  # a continuum seldom repeats
    by_action = []
    for a in range(env.n_actions):
        rows = np.flatnonzero(action == a)
        rest = np.setdiff1d(np.arange(len(points)), state[rows])
        x = points[state[rows]]
        by_action.append(ActionRows(rows, x, count[rows], points[rest], rest))
    parts = tuple(by_action)
    return Dataset(
        points, probed, state, action, reward, next_state, absorbing, count, parts
    )
