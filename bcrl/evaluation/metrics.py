"""Metrics: what is measured after each FQI iteration, in the task being trained."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bcrl.common.seeding import stream
from bcrl.envs import Env, is_simulated
from bcrl.errors import BcrlError, ConfigError, did_you_mean
from bcrl.evaluation import oracle
from bcrl.learning.fqi import Iteration
from bcrl.learning.rollout import (
    Episodes,
    draws,
    evaluation_starts,
    rollout,
    start_states,
    success_of,
)
from bcrl.q.functions import Values


@dataclass(frozen=True)
class View:
    """One seed's snapshot, as the metrics see it."""

    q: NDArray[np.float64]  # (n_probe, A) at the probed states
    residual: NDArray[np.float64]  # (n_probe, A)
    returns: NDArray[np.float64]  # (E,) discounted returns of the greedy episodes
    solved: NDArray[np.bool_]  # (E,)
    start: NDArray[np.intp]  # (E,) where the episodes' starts are among the probed
    reference: NDArray[np.intp]  # (n,) where the states with a known Q* are
    q_star: NDArray[np.float64]  # (n, A) Q* of the task there
    optimum: float | None  # V*(s0) of the *target* task, mean over starts


def _return(view: View) -> float:
    return view.returns.mean()


def _q_error(view: View) -> float:
    return abs(view.q[view.reference] - view.q_star).mean()


def _q_error_start(view: View) -> float:
    return abs(view.q[view.start] - view.optimum).mean()


def _residual_start(view: View) -> float:
    return view.residual[view.start].mean()


def _solved(view: View) -> float:
    return view.solved.mean()


#: name in the CSV → its definition (docs/metrics.md says the same in words)
METRICS: dict[str, Callable[[View], float]] = {
    "return": _return,
    "q_error": _q_error,
    "q_error_start": _q_error_start,
    "residual_start": _residual_start,
    "solved": _solved,
}


def check(metrics: Sequence[str], target: Env) -> None:
    """Raise ConfigError for a metric that is unknown or that `target` can't have."""
    for name in metrics:
        if not isinstance(name, str) or name not in METRICS:
            raise ConfigError("env.metrics", name, did_you_mean(str(name), METRICS))
        if name.startswith("q_error") and not oracle.available(target):
            raise ConfigError("env.metrics", name, f"no Q* of {target.name} is known")
    if "q_error_start" in metrics and len(target.evaluation_states()) != 1:
        why = f"{target.name} is not evaluated from one start state"
        raise ConfigError("env.metrics", "q_error_start", why)


@dataclass
class Probe:
    """Measures snapshots of several seeds; draws from the evaluation streams only."""

    seeds: Sequence[int]
    tasks: Sequence[Env]
    metrics: Sequence[str]
    kept: list[Values] = field(default_factory=list)  # residuals at each stage's end
    #: By place, which seeds can't go on after the latest measurement, and why.
    failed: dict[int, str] = field(default_factory=dict)

    index: ClassVar[str] = "iteration"  # what a snapshot's count is

    @property
    def target(self) -> Env:
        """The task that is to be solved in the end."""
        return self.tasks[-1]

    @cached_property
    def states(self) -> NDArray[np.float64]:
        """The probed states (n_probe, d)."""
        return probed_states(self.target)

    @cached_property
    def optimum(self) -> float | None:
        """V*(s0) of the target, if the oracle knows the only evaluation state."""
        known, start = oracle.reference(self.target), self.target.evaluation_states()
        if known is None or len(start) != 1:
            return None
        at = np.flatnonzero((known.states == start).all(-1))
        return float(known.q[at[0]].max()) if len(at) else None

    def measure(self, snapshot: Iteration) -> list[dict[str, float]]:
        """Each seed's metrics."""
        env = snapshot.stage.env
        rngs = [stream(seed, "evaluation", snapshot.count) for seed in self.seeds]
        start = np.stack([evaluation_starts(rng, env) for rng in rngs])
        u = np.stack([draws(rng, env, start.shape[1]) for rng in rngs])
        episodes = rollout(env, snapshot.learned.q, start, u)
        self.failed = episodes.failed | snapshot.failed
        returns = episodes.discounted_return(env.gamma)
        solved = episodes.solved(success_of(env))
        start_rows, rows, q_star = _layout(env, self.target)
        views = (
            View(
                snapshot.probed_q[s],
                snapshot.probed_residual[s],
                returns[s],
                solved[s],
                start_rows,
                rows,
                q_star,
                self.optimum,
            )
            for s in range(len(self.seeds))
        )
        if snapshot.last_of_stage:
            self.kept.append(snapshot.probed_residual)
            self._last = snapshot
        return [
            {
                m: float("nan" if s in self.failed else METRICS[m](v))
                for m in self.metrics
            }
            for s, v in enumerate(views)
        ]

    def arrays(self, s: int) -> dict[str, NDArray]:
        """What seed number s ends with: Q and residuals at the probed states."""
        found = {
            "states": self.states,
            "q": self._last.probed_q[s],
            "residuals": np.stack([each[s] for each in self.kept]),
        }
        return found | trajectory(self._shown, s, 0) | scene(self.tasks)

    @cached_property
    def _shown(self) -> Episodes:
        """A greedy episode of each seed in the target task, after the last iteration.

        Where the evaluation is one episode from the task's own start, this is it.
        """
        now = self._last
        rngs = [stream(seed, "evaluation", now.count) for seed in self.seeds]
        start = np.stack([start_states(rng, self.target, 1) for rng in rngs])
        u = np.stack([draws(rng, self.target, 1) for rng in rngs])
        shown = rollout(self.target, now.learned.q, start, u)
        self.failed = shown.failed | self.failed
        return shown

    def facts(self) -> dict[str, Any]:
        """What else is known of the run."""
        return {"optimum": self.optimum}


def trajectory(played: Episodes, s: int, e: int) -> dict[str, NDArray]:
    """Seed number s's episode number e, to be looked at."""
    length = played.length[s, e]
    return {
        "trajectory": played.state[s, e, : length + 1],  # (T + 1, d)
        "trajectory_actions": played.action[s, e, :length],  # (T,), or forces (T, k)
        "trajectory_start": played.start[s, e],  # a simulator's: what reset it
    }


def scene(tasks: Sequence[Env]) -> dict[str, NDArray]:
    """What a figure needs to draw the tasks, as far as they say."""
    target = tasks[-1]
    if hasattr(target, "walls"):
        return {"walls": np.stack([task.walls for task in tasks]), "goal": target.goal}
    return target.scene() if hasattr(target, "scene") else {}


@lru_cache(maxsize=64)
def probed_states(target: Env) -> NDArray[np.float64]:
    """All states of an env that lists them, else those the metrics need, (n, d)."""
    if hasattr(target, "states"):
        return target.states()
    known = oracle.reference(target)
    asked = [target.evaluation_states()] + ([known.states] if known else [])
    return np.unique(np.concatenate(asked), axis=0)


@lru_cache(maxsize=64)
def _layout(env: Env, target: Env) -> tuple[NDArray, NDArray, NDArray]:
    """Rows of the start states and of Q*'s states among the probed ones, and Q*."""
    states = probed_states(target)

    def rows(of: NDArray) -> NDArray[np.intp]:
        match = (of[:, None] == states[None]).all(-1)
        if not match.any(1).all():
            raise BcrlError(f"{env}: its evaluation states are not the target's")
        return match.argmax(1)

    known = oracle.reference(env)
    # A simulator starts where it likes: Q is looked at where the target may start.
    start = rows((target if is_simulated(env) else env).evaluation_states())
    if known is None:
        return start, np.empty(0, np.intp), np.empty((0, env.n_actions))
    return start, rows(known.states), known.q
