"""Datasets of transitions over distinct points; a finite env's rows have counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bcrl.common.serialization import storable
from bcrl.envs import Env, is_finite
from bcrl.learning.rollout import Episodes, transition_tables


@storable
@dataclass(frozen=True)
class ActionRows:
    """The regression problem of one action: n rows, and the points it doesn't cover."""

    rows: NDArray[np.intp]  # (n,) rows of the dataset
    x: NDArray[np.float32]  # (n, d) their states
    multiplicity: NDArray[np.int64]  # (n,) how often each row was seen
    queries: NDArray[np.float32]  # (m, d) the points without a row
    query_points: NDArray[np.intp]  # (m,) which points those are


@storable
@dataclass(frozen=True)
class Dataset:
    """One seed's transitions; states are rows of `points`, so Q is asked once a point.

    Regressors see float32, so states that agree in float32 are one point.
    """

    points: NDArray[np.float32]  # (P, d) distinct states, with those to be probed
    probe: NDArray[np.intp]  # (n_probe,) where the probed states lie in `points`
    state: NDArray[np.intp]  # (n,)
    action: NDArray[np.intp]  # (n,)
    reward: NDArray[np.float64]  # (n,)
    next_state: NDArray[np.intp]  # (n,)
    absorbing: NDArray[np.bool_]  # (n,)
    multiplicity: NDArray[np.int64]  # (n,)
    by_action: tuple[ActionRows, ...]


def build(env: Env, episodes: Episodes, seed: int, probe: NDArray) -> Dataset:
    """The dataset of seed number `seed` of `episodes`; `probe` (n, d) are asked too."""
    seen = np.arange(episodes.reward.shape[-1]) < episodes.length[seed][:, None]
    before = episodes.state[seed, :, :-1][seen]
    action = episodes.action[seed][seen]
    if is_finite(env):
        points = env.states().astype(np.float32)
        probed = env.index(probe)
        pair = env.index(before) * env.n_actions + action
        seen_how_often = np.bincount(pair)
        pairs = np.flatnonzero(seen_how_often)
        state, action = np.divmod(pairs, env.n_actions)
        next_state, reward, absorbing = (
            table[state, action] for table in transition_tables(env)
        )
        multiplicity = seen_how_often[pairs]
    else:
        after = episodes.state[seed, :, 1:][seen]
        every = np.concatenate([before, after, probe]).astype(np.float32)
        first, label = _distinct(every.T)
        points = every[first]
        state, next_state, probed = np.split(label, [len(before), 2 * len(before)])
        reward = episodes.reward[seed][seen]
        absorbing = episodes.absorbing[seed][seen]
        multiplicity = np.ones(len(state), np.int64)  # a continuum seldom repeats
    by_action = tuple(
        _action_rows(points, state, np.flatnonzero(action == a), multiplicity)
        for a in range(env.n_actions)
    )
    return Dataset(
        points,
        probed,
        state,
        action,
        reward,
        next_state,
        absorbing,
        multiplicity,
        by_action,
    )


def _action_rows(
    points: NDArray, state: NDArray, rows: NDArray, multiplicity: NDArray
) -> ActionRows:
    covered = np.zeros(len(points), bool)
    covered[state[rows]] = True
    rest = np.flatnonzero(~covered)
    return ActionRows(rows, points[state[rows]], multiplicity[rows], points[rest], rest)


def _distinct(columns) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First occurrence of each distinct row of `columns`, and each row's label."""
    label = np.zeros(len(columns[0]), np.intp)
    for column in columns:
        values, rank = np.unique(column, return_inverse=True)
        label = np.unique(label * len(values) + rank, return_inverse=True)[1]
    return np.unique(label, return_index=True)[1], label
