"""Action-value functions of several seeds at once, and sums of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bcrl.common import plugins
from bcrl.common.seed_axis import seeds_on
from bcrl.common.serialization import storable
from bcrl.envs import FiniteEnv
from bcrl.errors import BcrlError, LostSeeds

Values = Sequence[NDArray[np.float64]]
NOT_FINITE = "Q is not finite"  # why a seed failed


class Q(Protocol):
    """Q-functions of S seeds; of states stacked in one array, the values are, too."""

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        """Action values, S arrays (n_s, A), at S arrays of states (n_s, d)."""


def each(states: Sequence[NDArray], values: Callable[[int], NDArray]) -> Values:
    """`values(s)` for every seed, stacked if the states are."""
    found = [values(s) for s in range(len(states))]
    return np.stack(found) if isinstance(states, np.ndarray) else found


def check_states(states: Sequence[NDArray], n_seeds: int, d: int) -> None:
    """Raise BcrlError unless there are `n_seeds` arrays of states with `d` entries."""
    if len(states) != n_seeds:  # compiled code would read beyond its arrays
        why = f"a Q-function of {n_seeds} seeds can't be evaluated at states of "
        raise BcrlError(f"{why}{len(states)}; pass one array of states per seed")
    for x in states[:1] if isinstance(states, np.ndarray) else states:
        if x.shape[-1] != d:
            raise BcrlError(
                f"a Q-function of states with {d} entries can't be evaluated at states "
                f"with {x.shape[-1]}; pass a simulator's observations"
            )


def rows_of(env: FiniteEnv, state: NDArray[np.float64]) -> NDArray[np.intp]:
    """The row of each state (..., d) in `env.states()`; BcrlError if there is none."""
    row = np.asarray(env.index(state))
    if row.size and not 0 <= row.min() <= row.max() < len(env.states()):
        raise BcrlError(f"{env}: index() returns rows that states() doesn't have")
    return row


def query(
    q: Q, states: Sequence[NDArray[np.float64]], n_actions: int
) -> tuple[list[NDArray[np.float64]], dict[int, str]]:
    """Values (n_s, A) of S seeds, and why some failed (zeros), by their index."""
    failed: dict[int, str] = {}
    while True:
        queried = [x[:0] if s in failed else x for s, x in enumerate(states)]
        try:
            values = list(q(queried, n_actions))
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
    """Q = 0, what an approximator predicts before its first fit."""

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        if isinstance(states, np.ndarray):
            return np.zeros((*states.shape[:-1], n_actions))
        return [np.zeros((len(x), n_actions)) for x in states]


ZERO = Zero()


def together(
    terms: Sequence[Q], states: Sequence[NDArray[np.float64]], n_actions: int
) -> list[Values]:
    """The values of each term, by the terms' own `together` if they are of one type."""
    bare = [term.q if isinstance(term, Scaled) else term for term in terms]
    kinds = {type(q) for q in bare}
    joint = getattr(kinds.pop(), "together", None) if len(kinds) == 1 else None
    if joint is not None:
        values = joint(bare, states, n_actions)
    else:
        values = [q(states, n_actions) for q in bare]
    pairs = zip(terms, values, strict=True)
    return [x.times(v, states) if isinstance(x, Scaled) else v for x, v in pairs]


@storable
@dataclass(frozen=True)
class Sum:
    """The sum of Q-functions: a frozen base and the residuals learned on it."""

    terms: tuple[Q, ...]

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        values = together(self.terms, states, n_actions)
        if isinstance(states, np.ndarray):
            return reduce(np.add, values)
        return [reduce(np.add, own) for own in zip(*values, strict=True)]


@storable
@dataclass(frozen=True)
class Scaled:
    """A Q-function times a factor of each seed."""

    q: Q
    factor: NDArray[np.float64] = field(metadata=seeds_on(0))  # (S,)

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        return self.times(self.q(states, n_actions), states)

    def times(self, values: Values, states: Sequence[NDArray]) -> Values:
        """The factors times the values of `q`."""
        return each(states, lambda s: self.factor[s] * values[s])


@storable
@dataclass(frozen=True)
class Mapped:
    """A Q-function of other observations: q(observation(s)), state by state."""

    q: Q
    observation: str  # the function, module.function

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        key, name = "start.observation", self.observation
        of = plugins.attribute(key, name, name)
        seen = [np.array([of(state) for state in x], np.float64) for x in states]
        if not any(map(len, seen)):
            return ZERO(states, n_actions)
        shape = next(x.shape[1:] for x in seen if len(x))
        seen = [x if len(x) else np.empty((0, *shape)) for x in seen]
        given: Any = np.stack(seen) if isinstance(states, np.ndarray) else seen
        return self.q(given, n_actions)


@storable
@dataclass(frozen=True)
class Shaped:
    """base + ϱ + max_a' potential(s, a'), which undoes the shaping of the rewards."""

    base: Q
    residual: Q
    potential: Q

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        base, own = self.base(states, n_actions), self.residual(states, n_actions)
        same = self.potential is self.base  # queried once: it may be stacked itself
        v = base if same else self.potential(states, n_actions)
        return each(states, lambda s: base[s] + own[s] + v[s].max(-1, keepdims=True))


def scaled(q: Q, factor: NDArray[np.float64]) -> Q:
    """q times factors (S,), term by term, so that a sum stays a flat one."""
    if isinstance(q, Sum):
        return Sum(tuple(scaled(term, factor) for term in q.terms))
    if isinstance(q, Scaled):
        return Scaled(q.q, factor * q.factor)
    return Scaled(q, factor)


def add(base: Q, residual: Q) -> Q:
    """base + residual, flattened and without zeros."""
    terms: list[Q] = []
    for q in (base, residual):
        terms += q.terms if isinstance(q, Sum) else [] if q is ZERO else [q]
    return terms[0] if len(terms) == 1 else Sum(tuple(terms)) if terms else ZERO


class MemoizedQ:
    """A frozen Q that is evaluated once at each state; most states come again."""

    def __init__(self, q: Q) -> None:
        self.q = q
        self._values: dict[tuple[int, bytes], NDArray[np.float64]] = {}  # seed, state

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        keys = [[(s, state.tobytes()) for state in x] for s, x in enumerate(states)]
        cached = self._values
        new = [[i for i, key in enumerate(own) if key not in cached] for own in keys]
        if any(new):
            queried = [x[rows] for x, rows in zip(states, new, strict=True)]
            values = self.q(queried, n_actions)
            for own, rows, fresh in zip(keys, new, values, strict=True):
                cached.update(zip((own[i] for i in rows), fresh, strict=True))
        found = [np.array([cached[key] for key in own]) for own in keys]
        return each(states, lambda s: found[s].reshape(-1, n_actions))


def memoized(q: Q) -> Q:
    """`q`, evaluated once at each state; zero stays itself."""
    return q if q is ZERO else MemoizedQ(q)


@storable
@dataclass(frozen=True)
class Table:
    """The Q-table of a finite environment, one array (N, A) per seed."""

    values: Sequence[NDArray[np.float64]] = field(metadata=seeds_on(0))
    env: FiniteEnv

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        check_states(states, len(self.values), self.env.state_dim)
        return each(states, lambda s: self.values[s][rows_of(self.env, states[s])])
