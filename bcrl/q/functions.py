"""Action-value functions of several seeds at once, and sums of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bcrl.common.serialization import storable
from bcrl.envs import Env, FiniteEnv
from bcrl.errors import BcrlError, LostSeeds

Values = Sequence[NDArray[np.float64]]
NOT_FINITE = "Q is not finite"  # why a seed failed


class Q(Protocol):
    """Q-functions of S seeds; seed s is asked at its own states.

    S arrays may be one stacked array (S, n, d); the values are stacked then, too.
    """

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        """Action values, S arrays (n_s, A), at S arrays of states (n_s, d)."""


def each(states: Sequence[NDArray], values: Callable[[int], NDArray]) -> Values:
    """`values(s)` for every seed, stacked if the states are."""
    found = [values(s) for s in range(len(states))]
    return np.stack(found) if isinstance(states, np.ndarray) else found


def check_width(states: Sequence[NDArray], d: int) -> None:
    """Raise BcrlError unless all states have the `d` entries that a Q was learned on.

    Compiled code would read what lies beside a shorter state.
    """
    stacked = isinstance(states, np.ndarray)
    for width in {x.shape[-1] for x in ((states,) if stacked else states)}:
        if width != d:
            why = "a simulator's observations are its states, not what resets it"
            raise BcrlError(f"Q of states with {d} entries asked at {width}: {why}")


def rows_of(env: FiniteEnv, state: NDArray[np.float64]) -> NDArray[np.intp]:
    """The row of each state (..., d) in `env.states()`; BcrlError if there is none."""
    row = np.asarray(env.index(state))
    if row.size and not 0 <= row.min() <= row.max() < len(env.states()):
        raise BcrlError(f"{env}: index gives rows that states() doesn't have")
    return row


def ask(
    q: Q, states: Sequence[NDArray[np.float64]], n_actions: int
) -> tuple[list[NDArray[np.float64]], dict[int, str]]:
    """Values (n_s, A) of S seeds, and by place why a seed's can't be used.

    A seed whose Q can't be asked gets zeros; the others' values don't depend on it.
    """
    failed: dict[int, str] = {}
    while True:
        asked = [x[:0] if s in failed else x for s, x in enumerate(states)]
        try:
            values = list(q(asked, n_actions))
            break
        except LostSeeds as error:
            if error.reasons.keys() <= failed.keys():
                raise
            failed |= error.reasons
    for s, x in enumerate(states):
        if s in failed:
            values[s] = np.zeros((len(x), n_actions))
        elif not np.isfinite(values[s]).all():
            failed[s] = NOT_FINITE
    return values, failed


class Zero:
    """Q = 0: what an unfitted approximator predicts."""

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        if isinstance(states, np.ndarray):
            return np.zeros((*states.shape[:-1], n_actions))
        return [np.zeros((len(x), n_actions)) for x in states]


ZERO = Zero()


@storable
@dataclass(frozen=True)
class Sum:
    """The sum of Q-functions: a frozen base and the residuals learned on it."""

    terms: tuple[Q, ...]

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        total, *rest = (term(states, n_actions) for term in self.terms)
        for values in rest:
            if isinstance(states, np.ndarray):
                total = total + values
            else:
                total = [a + b for a, b in zip(total, values, strict=True)]
        return total


@storable
@dataclass(frozen=True)
class Shaped:
    """base + ϱ + max_a' potential(s, a'): undoes what shaping took off the rewards.

    A base that is the potential, too, is asked once: stages may be stacked on stages.
    """

    base: Q
    residual: Q
    potential: Q

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        base, own = self.base(states, n_actions), self.residual(states, n_actions)
        same = self.potential is self.base
        v = base if same else self.potential(states, n_actions)
        return each(
            states,
            lambda s: base[s] + own[s] + v[s].max(-1, keepdims=True),
        )


def add(base: Q, residual: Q) -> Q:
    """base + residual, flattened and without zeros."""
    terms: list[Q] = []
    for q in (base, residual):
        terms += q.terms if isinstance(q, Sum) else [] if q is ZERO else [q]
    return terms[0] if len(terms) == 1 else Sum(tuple(terms)) if terms else ZERO


class MemoizedQ:
    """A frozen Q that is asked once at each state.

    The greedy episodes of an iteration meet most of the states of those before.
    """

    def __init__(self, q: Q) -> None:
        self.q = q
        self._known: dict[int, dict[bytes, NDArray[np.float64]]] = {}  # by seed

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        known = [self._known.setdefault(s, {}) for s in range(len(states))]
        keys = [[state.tobytes() for state in x] for x in states]
        new = [
            [i for i, key in enumerate(row) if key not in found]
            for row, found in zip(keys, known, strict=True)
        ]
        if any(new):
            asked = [x[rows] for x, rows in zip(states, new, strict=True)]
            values = self.q(asked, n_actions)
            for s, rows in enumerate(new):
                known[s].update(zip((keys[s][i] for i in rows), values[s], strict=True))
        return each(
            states,
            lambda s: np.array([known[s][k] for k in keys[s]]).reshape(-1, n_actions),
        )


def memoized(q: Q) -> Q:
    """`q`, asked once at each state; zero costs nothing and stays itself."""
    return q if q is ZERO else MemoizedQ(q)


@storable
@dataclass(frozen=True)
class Table:
    """Tabulated Q of a finite environment: one array (N, A) a seed."""

    values: Sequence[NDArray[np.float64]]
    env: Env

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        check_width(states, self.env.state_dim)
        return each(states, lambda s: self.values[s][rows_of(self.env, states[s])])
