"""Datasets of transitions over distinct points, as fitted Q-iteration needs them."""

from __future__ import annotations

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
        points = env.states().astype(np.float32)
        probed = env.index(probe)
        pair = env.index(before) * env.n_actions + action
        counts = np.bincount(pair)
        pairs = np.flatnonzero(counts)
        count = counts[pairs]
        state, action = np.divmod(pairs, env.n_actions)
        to, pays, ends = transition_tables(env)
        next_state, reward = to[state, action], pays[state, action]
        absorbing = ends[state, action]
    else:
        after = episodes.state[seed, :, 1:][seen]
        every = np.concatenate([before, after, probe]).astype(np.float32)
        first, label = _distinct(every.T)
        points = every[first]
        state, next_state, probed = np.split(label, [len(before), 2 * len(before)])
        reward = episodes.reward[seed][seen]
        absorbing = episodes.absorbing[seed][seen]
        count = np.ones(len(state), np.int64)  # a continuum seldom repeats
    by_action = []
    for a in range(env.n_actions):
        rows, uncovered = np.flatnonzero(action == a), np.ones(len(points), bool)
        uncovered[state[rows]] = False
        rest = np.flatnonzero(uncovered)
        x = points[state[rows]]
        by_action.append(ActionRows(rows, x, count[rows], points[rest], rest))
    parts = tuple(by_action)
    return Dataset(
        points, probed, state, action, reward, next_state, absorbing, count, parts
    )


def _distinct(columns: NDArray) -> tuple[Integers, Integers]:
    """First occurrence of each distinct row of `columns`, and each row's label."""
    label = np.zeros(len(columns[0]), np.intp)
    for column in columns:
        values, rank = np.unique(column, return_inverse=True)
        label = np.unique(label * len(values) + rank, return_inverse=True)[1]
    return np.unique(label, return_index=True)[1], label
