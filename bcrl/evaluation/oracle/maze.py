"""Q* of the maze: value iteration on its lattice."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bcrl.envs.base import FiniteEnv
from bcrl.envs.maze import Maze
from bcrl.evaluation.oracle import Reference

ENV = Maze


def optimal_q(
    next_index: NDArray[np.integer],
    reward: NDArray[np.float64],
    absorbing: NDArray[np.bool_],
    gamma: float,
) -> NDArray[np.float64]:
    """Q* (N, A) of a deterministic finite task: the Bellman operator's float fixpoint.

    All arrays have shape (N, A); `next_index` holds rows. Starts below Q*, from where
    the iterates never fall (rounding is monotone too), so that it must come to rest.
    """
    worst = min(reward.min(), 0.0) / (1.0 - gamma)
    q = np.full(reward.shape, worst * (1.0 + 1e-6))
    discount = np.where(absorbing, 0.0, gamma)
    while True:
        new = reward + discount * q.max(-1)[next_index]
        if not (new > q).any():
            return new
        q = new


def lattice_q(env: FiniteEnv) -> NDArray[np.float64]:
    """Q* (N, A) on all of `env.states()`."""
    n, actions = len(env.states()), np.arange(env.n_actions)
    every = np.broadcast_to(env.states()[:, None], (n, len(actions), env.state_dim))
    after, reward, absorbing = env.step(
        every, np.broadcast_to(actions, every.shape[:2])
    )
    return optimal_q(env.index(after), reward, absorbing, env.gamma)


def start_value(env: FiniteEnv) -> float:
    """V*(s0) of the start state."""
    start = env.initial(np.zeros(env.initial_noise))
    return float(lattice_q(env)[env.index(start)].max())


def reference(env: Maze) -> Reference:
    """Q* where an agent can stand and still has to act: neither wall nor goal.

    A preset whose positions leave the lattice is compared with the lattice's Q*, as the
    authors compare their floating-point maze with V*(s0) = −47.5576.
    """
    if not env.finite:
        env = replace(env, preset="lattice")
    states = env.states()
    inside = ~(env.blocked(states) | env.is_goal(states))
    return Reference(states[inside], lattice_q(env)[inside])


def table(env: Maze) -> Iterator[str]:
    """CSV lines `x,y,action,q`, states outermost."""
    yield "x,y,action,q"
    known = reference(env)
    for (x, y), values in zip(known.states.tolist(), known.q.tolist(), strict=True):
        for action, q in enumerate(values):
            yield f"{x},{y},{action},{q}"
