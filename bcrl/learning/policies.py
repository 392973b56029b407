"""Policies as pure functions of action values and uniform draws."""

import numpy as np

from bcrl.common.arrays import writable
from bcrl.common.compiling import compiled, kept
from bcrl.learning import Floats, Integers

TIE = 1e-9  # distances between actions that differ by less are equal


@compiled()
def _choice(q, explore, u, epsilon):
    """⌊u A⌋ if `explore` is below ε, else the greatest of q (A,); 0 if NaN hides it."""
    if explore < epsilon:
        return int(u * len(q))
    best, ties = q[0], 1
    for a in range(1, len(q)):
        if q[a] > best:
            best, ties = q[a], 1
        elif q[a] == best:
            ties += 1
    rank = int(u * ties)
    for a in range(len(q)):
        if q[a] == best:
            if rank == 0:
                return a
            rank -= 1
    return 0


@kept(nogil=True)
def _choices(q, explore, u, epsilon):
    action = np.empty(len(q), np.intp)
    for i in range(len(q)):
        action[i] = _choice(q[i], explore[i], u[i], epsilon[i % len(epsilon)])
    return action


def epsilon_greedy(
    q: Floats, explore: Floats, u: Floats, epsilon: Floats | float
) -> Integers:
    """⌊u A⌋ where `explore` (...) < ε (one, or one per last index), else `greedy`'s."""
    rows = writable(q).reshape(-1, q.shape[-1])
    drawn = (np.array(x, np.float64, order="C").ravel() for x in (explore, u, epsilon))
    return _choices(rows, *drawn).reshape(u.shape)


def greedy(q: Floats, u: Floats) -> Integers:
    """The best action of q (..., A); ties are broken uniformly by u (...) in [0, 1)."""
    return epsilon_greedy(q, u, u, 0.0)


def combined_actions(actions: Floats) -> Integers:
    """The action that RPL executes, table (A, A) over the prior's and the own action.

    It is the action of `actions` (A, k) nearest to their sum; the own action if they
    cancel, and among equally near ones the one nearest to the own. Source: paper, C.3.
    """
    total = actions[:, None] + actions[None]  # (A, A, k)
    distance = np.linalg.norm(total[:, :, None] - actions, axis=-1)  # (A, A, A)
    from_own = np.linalg.norm(actions[:, None] - actions, axis=-1)  # (A, A)
    nearest = distance <= distance.min(-1, keepdims=True) + TIE
    table = np.where(nearest, from_own[None], np.inf).argmin(-1)
    own = np.broadcast_to(np.arange(len(actions)), table.shape)
    return np.where(np.linalg.norm(total, axis=-1) < TIE, own, table)


@kept(nogil=True)
def walk(next_row, reward, absorbing, q, first, u, epsilon):
    """One seed's ε-greedy episodes in a finite task, row by row from `first` (E,).

    next_row, reward, absorbing, q: tables (N, A); u: uniforms (T, E, 2 or more).
    Returns rows (E, T + 1), actions (E, T) and lengths (E,).
    """
    horizon, episodes = u.shape[0], u.shape[1]
    row = np.empty((episodes, horizon + 1), np.intp)
    action = np.zeros((episodes, horizon), np.intp)
    length = np.zeros(episodes, np.intp)
    for e in range(episodes):
        at, done = first[e], False
        row[e, 0] = at
        for t in range(horizon):
            if not done:
                act = _choice(q[at], u[t, e, 0], u[t, e, 1], epsilon)
                action[e, t] = act
                length[e] = t + 1
                at, done = next_row[at, act], absorbing[at, act]
            row[e, t + 1] = at
    return row, action, length
