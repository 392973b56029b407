"""Datasets of transitions over distinct points, as fitted Q-iteration needs them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bcrl.common.serialization import storable
from bcrl.envs import Env, FiniteEnv, is_finite
from bcrl.learning import Booleans, Floats, Integers
from bcrl.learning.rollout import Episodes, transition_tables
from bcrl.learning.transitions import Transitions


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
        points, probed = _listed(env, probe)
        pairs = env.index(before) * env.n_actions + action
        pairs, count = np.unique(pairs, return_counts=True)
        state, action = at = np.divmod(pairs, env.n_actions)
        to, pays, ends = transition_tables(env)
        next_state, reward, absorbing = to[at], pays[at], ends[at]
    else:
        after = episodes.state[seed, :, 1:][seen]
        points, state, next_state, probed = _distinct(before, after, probe)
        reward, absorbing = episodes.reward[seed][seen], episodes.absorbing[seed][seen]
        count = np.ones(len(state), np.int64)  # a continuum seldom repeats
    rows = state, action, reward, next_state, absorbing, count
    return Dataset(points, probed, *rows, _by_action(env, points, state, action))


def of_logged(env: Env, given: Transitions, probe: Floats) -> Dataset:
    """The dataset of logged transitions; `probe` (n, d) is among its points."""
    before, after = given.observation, given.next_observation
    action, reward = given.action.astype(np.intp), given.reward.astype(np.float64)
    if is_finite(env):
        points, probed = _listed(env, probe)
        # What was logged counts, not what `env` would have answered.
        columns = env.index(before), action, env.index(after), given.absorbing, reward
        table, count = np.unique(np.stack(columns, 1), axis=0, return_counts=True)
        state, action, next_state = table[:, :3].T.astype(np.intp)
        absorbing, reward = table[:, 3] == 1.0, table[:, 4].copy()
    else:
        points, state, next_state, probed = _distinct(before, after, probe)
        absorbing, count = given.absorbing, np.ones(len(state), np.int64)
    rows = state, action, reward, next_state, absorbing, count
    return Dataset(points, probed, *rows, _by_action(env, points, state, action))


def _listed(env: FiniteEnv, probe: Floats) -> tuple[NDArray, Integers]:
    """The points of an env that lists its states, and the probed ones among them."""
    return env.states().astype(np.float32), env.index(probe)


def _distinct(before: Floats, after: Floats, probe: Floats) -> tuple[NDArray, ...]:
    """The distinct points among all states, and where each state is among them."""
    every, n = np.concatenate([before, after, probe]).astype(np.float32), len(before)
    points, label = np.unique(every, axis=0, return_inverse=True)
    return points, *np.split(label.reshape(-1), [n, 2 * n])


def _by_action(
    env: Env, points: NDArray, state: Integers, action: Integers
) -> list[tuple[Integers, Integers]]:
    found = []
    for a in range(env.n_actions):
        own = np.flatnonzero(action == a)
        found.append((own, np.setdiff1d(np.arange(len(points)), state[own])))
    return found
