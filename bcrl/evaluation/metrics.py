"""Metrics: what is measured after each FQI iteration, in the task being trained."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bcrl.common.seeding import stream
from bcrl.envs import Env, is_simulated
from bcrl.errors import BcrlError, ConfigError, did_you_mean
from bcrl.evaluation import oracle
from bcrl.evaluation.probe import SeedProbe
from bcrl.learning import Booleans, Floats, Integers
from bcrl.learning.fqi import Iteration
from bcrl.learning.rollout import (
    Episodes,
    draws,
    evaluation_starts,
    rollout,
    starts_and_draws,
    success_of,
)


@dataclass(frozen=True)
class View:
    """One seed's snapshot, as the metrics see it."""

    q: Floats  # (n_probe, A) at the probed states
    residual: Floats  # (n_probe, A)
    returns: Floats  # (E,) discounted returns of the greedy episodes
    solved: Booleans  # (E,)
    start: Integers  # (E,) the starts of the episodes among the probed states
    reference: Integers  # (n,) the states with a known Q* among the probed states
    q_star: Floats  # (n, A) Q* of the trained task there
    optimum: float  # V*(s0) of the *target* task, nan if unknown


#: name in the CSV → its definition (docs/reference/metrics.md explains them)
METRICS: dict[str, Callable[[View], float]] = {
    "return": lambda view: view.returns.mean(),
    "q_error": lambda view: abs(view.q[view.reference] - view.q_star).mean(),
    "q_error_start": lambda view: abs(view.q[view.start] - view.optimum).mean(),
    "residual_start": lambda view: view.residual[view.start].mean(),
    "solved": lambda view: view.solved.mean(),
}


def check_metrics(metrics: Sequence[str], target: Env) -> None:
    """Raise ConfigError for a metric that is unknown or undefined for `target`."""
    for name in metrics:
        if not isinstance(name, str) or name not in METRICS:
            raise ConfigError("env.metrics", name, did_you_mean(str(name), METRICS))
        if name.startswith("q_error") and not oracle.has_oracle(target):
            raise ConfigError("env.metrics", name, f"no Q* of {target.name} is known")
    if "q_error_start" in metrics and len(target.evaluation_states()) != 1:
        why = f"{target.name} is not evaluated from one start state"
        raise ConfigError("env.metrics", "q_error_start", why)


class Probe(SeedProbe):
    """Measures FQI's iterations; draws from the evaluation streams only."""

    index = "iteration"

    def __init__(
        self, seeds: Sequence[int], tasks: Sequence[Env], metrics: Sequence[str]
    ) -> None:
        super().__init__(seeds, tasks)
        self.metrics = metrics

    @cached_property
    def states(self) -> Floats:
        return probed_states(self.target)

    @cached_property
    def optimum(self) -> float | None:
        """V*(s0) of the target, if the oracle knows the only evaluation state."""
        known, start = oracle.reference(self.target), self.target.evaluation_states()
        if known is None or len(start) != 1:
            return None
        row = np.flatnonzero((known.states == start).all(-1))
        return float(known.q[row[0]].max()) if len(row) else None

    def measure(self, snapshot: Iteration) -> list[dict[str, float]]:
        """Each seed's metrics."""
        env = snapshot.stage.env
        rngs = [stream(seed, "evaluation", snapshot.count) for seed in self.seeds]
        start = np.stack([evaluation_starts(rng, env) for rng in rngs])
        u = np.stack([draws(rng, env, start.shape[1]) for rng in rngs])
        episodes = rollout(env, snapshot.result.q, start, u)
        self.failed = episodes.failed | snapshot.failed
        returns = episodes.discounted_return(env.gamma)
        solved = episodes.solved(success_of(env))
        start_rows, known, q_star = _layout(env, self.target)
        if snapshot.last_of_stage:
            self.kept.append(snapshot.probed_residual)
            self._last = snapshot
        optimum = np.nan if self.optimum is None else self.optimum
        rows = []
        for s, (q, residual) in enumerate(
            zip(snapshot.probed_q, snapshot.probed_residual, strict=True)
        ):
            outcomes = (returns[s], solved[s])
            view = View(q, residual, *outcomes, start_rows, known, q_star, optimum)
            row = {name: float(METRICS[name](view)) for name in self.metrics}
            void = s in self.failed
            rows.append(dict.fromkeys(row, np.nan) if void else row)
        return rows

    def final(self, s: int) -> dict[str, NDArray]:
        residuals = np.stack([residual[s] for residual in self.kept])
        last = self._last.probed_q[s]
        return {"states": self.states, "q": last, "residuals": residuals}

    @cached_property
    def _shown(self) -> Episodes:
        rngs = [stream(seed, "evaluation", self._last.count) for seed in self.seeds]
        start, u = starts_and_draws(rngs, self.target, 1)
        episodes = rollout(self.target, self._last.result.q, start, u)
        self.failed = episodes.failed | self.failed
        return episodes

    def shown(self) -> tuple[Episodes, int]:
        """A greedy episode in the target task, the evaluation's if it has only one."""
        return self._shown, 0

    def facts(self) -> dict[str, Any]:
        return {"optimum": self.optimum}


@lru_cache(maxsize=64)
def probed_states(target: Env) -> Floats:
    """All states of an env that lists them, else those that metrics need, (n, d)."""
    if hasattr(target, "states"):
        return target.states()
    known = oracle.reference(target)
    needed = [target.evaluation_states()] + ([known.states] if known else [])
    return np.unique(np.concatenate(needed), axis=0)


@lru_cache(maxsize=64)
def _layout(env: Env, target: Env) -> tuple[Integers, Integers, Floats]:
    """Rows of the start states and of Q*'s states among the probed ones, and Q*."""
    states = probed_states(target)

    def rows(of: Floats) -> Integers:
        match = (of[:, None] == states[None]).all(-1)
        if not match.any(1).all():
            raise BcrlError(f"{env}: its evaluation states are not the target's")
        return match.argmax(1)

    known = oracle.reference(env)
    # A simulator's starts are random: Q is recorded where the target may start.
    start = rows((target if is_simulated(env) else env).evaluation_states())
    if known is None:
        return start, np.empty(0, np.intp), np.empty((0, env.n_actions))
    return start, rows(known.states), known.q
