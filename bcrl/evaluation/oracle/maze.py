"""Q* of the maze: value iteration on its lattice."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from bcrl.envs.maze import Maze
from bcrl.learning import Booleans, Floats, Integers
from bcrl.learning.rollout import transition_tables

ENV = Maze


def optimal_q(
    next_row: Integers, reward: Floats, absorbing: Booleans, gamma: float
) -> Floats:
    """Q* (N, A) of a deterministic finite task: the Bellman operator's fixed point.

    All arrays have shape (N, A). Iterates start below Q*, from where they never fall
    (rounding is monotone, too), so the loop ends.
    """
    worst = min(reward.min(), 0.0) / (1.0 - gamma)
    q = np.full(reward.shape, worst * (1.0 + 1e-6))
    discount = np.where(absorbing, 0.0, gamma)
    while True:
        new = reward + discount * q.max(-1)[next_row]
        if not (new > q).any():
            return new
        q = new


def reference(env: Maze) -> tuple[Floats, Floats]:
    """The states (n, 2) where an agent has to act, neither wall nor goal, and Q* there.

    A preset whose positions leave the lattice is compared with the lattice's Q*, as the
    authors compare their floating-point maze with V*(s0) = −47.5576.
    """
    if not env.finite:
        env = replace(env, preset="lattice")
    states = env.states()
    inside = ~(env.blocked(states) | env.is_goal(states))
    return states[inside], optimal_q(*transition_tables(env), env.gamma)[inside]


def table(env: Maze) -> Iterator[str]:
    """CSV lines `x,y,action,q`, states outermost."""
    yield "x,y,action,q"
    states, q_star = reference(env)
    for (x, y), values in zip(states.tolist(), q_star.tolist(), strict=True):
        yield from (f"{x},{y},{action},{q}" for action, q in enumerate(values))
