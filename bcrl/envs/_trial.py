"""Random episodes before any work: is the contract kept, what has to be known?"""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bcrl.common.terminal import say
from bcrl.envs._lanes import SimulatedLanes
from bcrl.errors import BcrlError

if TYPE_CHECKING:
    from bcrl.envs.gymnasium import Gymnasium

TRIES = 5  # episodes
STEPS = 10_000  # of all of them together
SECONDS = 5.0  # after which a slow simulator is seen no further
NUMBERS = 4_000_000  # of the observations, kept to see how fine they are
#: Regressors compare float32, forests take what differs by less for equal.
FOREST = 1e-7
LEVELS = 10_000  # a component with more of them is fine enough

#: Say a note, once per process.
once = functools.cache(say)
#: Tasks, measured, whose episodes are the same only in new simulators.
FRESH: set[Gymnasium] = set()


@dataclass(frozen=True)
class Trial:
    """What random episodes have shown of a task."""

    trace: tuple[tuple[int, ...], ...]  # per time step, what each episode came to
    whole: bool  # whether the episodes were played to their ends
    unsteady: str  # where they were others when played again; empty if nowhere
    adapted: tuple[str, ...]  # what is made plain, in words
    coarse: tuple[str, ...]  # components that float32 does not resolve, in words
    reports: bool  # whether info says what a success is
    low: float  # least and largest reward of the steps that did not terminate
    high: float

    def differs(self, other: Trial) -> bool:
        """Whether two tasks lead anywhere else under the same resets and actions."""
        if self.whole and other.whole:
            return self.trace != other.trace
        return any(a != b for a, b in zip(self.trace, other.trace, strict=False))


@functools.lru_cache(maxsize=256)
def trial(task: Gymnasium) -> Trial:
    """Play random episodes side by side, then the same ones after each other.

    Raises BcrlError for the first thing that breaks Gymnasium's contract.
    """
    start = (np.arange(TRIES)[:, None] + 0.5) / TRIES
    steps = min(task.horizon, STEPS // TRIES)
    actions = np.random.default_rng(0).integers(task.n_actions, size=(steps, TRIES))
    lanes = SimulatedLanes(task)
    try:
        seen, rewards, trace = [], [], []
        ends, alive, whole = time.monotonic() + SECONDS, np.ones(TRIES, bool), True
        for state, reward, absorbing, cut in _played(lanes, start, actions):
            if rewards_of := reward[alive & ~absorbing].tolist() if trace else []:
                rewards += [min(rewards_of), max(rewards_of)]
            if sum(map(np.size, seen)) < NUMBERS:
                seen.append(state[alive])
            trace.append(_digests(state, reward, absorbing, cut))
            alive = alive & ~(absorbing | cut)
            if time.monotonic() > ends:
                break
        whole = not alive.any() or len(trace) > task.horizon
        adapted = dict.fromkeys(a for s in lanes.running if s for a in s.adapted)
        reports = any(s.reports for s in lanes.running if s)
    finally:
        lanes.close()
    unsteady = _again(task, start, actions, trace) if task.verify else ""
    if unsteady and not (unsteady := _again(task, start, actions, trace, fresh=True)):
        FRESH.add(task)
        adapted["a reset leaves something behind, so each episode has a new one"] = None
    return Trial(
        tuple(trace),
        whole,
        unsteady,
        tuple(adapted),
        tuple(coarse(np.concatenate(seen))),
        reports,
        min(rewards, default=0.0),
        max(rewards, default=0.0),
    )


def _played(
    lanes: SimulatedLanes, start: NDArray, actions: NDArray
) -> Iterator[tuple[NDArray, NDArray, NDArray, NDArray]]:
    """All lanes after the reset and after each step, until every episode is over."""
    n = len(start)
    state, reward = lanes.begin(start), np.zeros(n)
    absorbing, cut, alive = np.zeros(n, bool), np.zeros(n, bool), np.ones(n, bool)
    _raise(lanes)
    yield state, reward, absorbing, cut
    for action in actions:
        state, reward = state.copy(), np.zeros(n)
        absorbing, cut = np.zeros(n, bool), np.zeros(n, bool)
        found = lanes.step(None, action[alive], None, alive)
        state[alive], reward[alive], absorbing[alive], cut[alive] = found
        _raise(lanes)
        yield state, reward, absorbing, cut
        alive = alive & ~(absorbing | cut)
        if not alive.any():
            return


def _raise(lanes: SimulatedLanes) -> None:
    for why in lanes.failures.values():
        raise BcrlError(why)


def _digests(*parts: NDArray) -> tuple[int, ...]:
    return tuple(hash(tuple(p[i].tobytes() for p in parts)) for i in range(TRIES))


def _again(
    task: Gymnasium,
    start: NDArray,
    actions: NDArray,
    trace: Sequence[tuple],
    fresh: bool = False,
) -> str:
    """Where an episode is another, when one simulator, or `fresh` ones, play in turn.

    So neither randomness without a seed stays hidden, nor what outlives a reset, nor
    what simulators share.
    """
    lanes = SimulatedLanes(task)
    try:
        for e in range(TRIES):
            one = start[e : e + 1]
            if e == 0 or fresh:
                state = lanes.begin(one)
            else:
                state = lanes.restart(np.ones(1, bool), one, state)
            found = [state, np.zeros(1), np.zeros(1, bool), np.zeros(1, bool)]
            for t, expected in enumerate(trace):
                if t:
                    found = lanes.step(None, actions[t - 1, e : e + 1], None)
                _raise(lanes)
                digest = hash(tuple(np.asarray(part)[0].tobytes() for part in found))
                if digest != expected[e]:
                    what = f"step {t}" if t else "the reset"
                    return f"{what} of episode {e + 1}"
                if (found[2] | found[3]).any():
                    break
            state = found[0]
    finally:
        lanes.close()
    return ""


def coarse(seen: NDArray[np.float64]) -> Iterator[str]:
    """The components of states (n, d) whose values float32 takes for one another."""
    low, high = seen.min(0), seen.max(0)
    span, largest = high - low, np.maximum(np.abs(low), np.abs(high))
    fineness = np.maximum(np.spacing(largest.astype(np.float32)), FOREST)
    suspects = np.flatnonzero((span > 0) & (span < LEVELS * fineness))
    for i in suspects:
        values = np.round((seen[:, i] - low[i]) / span[i] * 1e9)
        rough = np.round((seen[:, i] - low[i]) / fineness[i])
        if len(np.unique(rough)) < len(np.unique(values)):
            yield (
                f"component {i} of the observations lies within {low[i]:.10g} and "
                f"{high[i]:.10g}, where float32 and forests resolve {fineness[i]:.2g}"
            )
