"""Probes measure the snapshots of several seeds; the metrics of FQI's iterations."""

from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bcrl.common.checks import one_of
from bcrl.common.seeding import stream
from bcrl.envs import Env, is_simulated
from bcrl.errors import BcrlError, ConfigError
from bcrl.evaluation import oracle
from bcrl.learning import Booleans, Floats, Integers, rollout
from bcrl.learning.fqi import Iteration
from bcrl.learning.line_search import Searched
from bcrl.learning.stage import Snapshot
from bcrl.results.layout import SCALE


class View(NamedTuple):
    """One seed's snapshot, as the metrics see it."""

    q: Floats  # (n_probe, A) at the probed states
    residual: Floats  # (n_probe, A)
    returns: Floats  # (E,) discounted returns of the greedy episodes
    solved: Booleans  # (E,)
    start: Integers  # (E,) the starts of the episodes among the probed states
    reference: Integers  # (n,) the states with a known Q* among the probed states
    q_star: Floats  # (n, A) Q* of the trained task there
    optimum: float | None  # V*(s0) of the *target* task, if known


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
        one_of("env.metrics", name, [*METRICS])
        if name.startswith("q_error") and not oracle.has_oracle(target):
            raise ConfigError("env.metrics", name, f"no Q* of {target.name} is known")
    if "q_error_start" in metrics and len(target.evaluation_states()) != 1:
        why = f"{target.name} is not evaluated from one start state"
        raise ConfigError("env.metrics", "q_error_start", why)


def needs_reference(metrics: Sequence[str]) -> bool:
    """Whether a metric compares with Q*, which an oracle has to search."""
    return any(name.startswith("q_error") for name in metrics)


class SeedProbe:
    """Measures the snapshots of several seeds, and keeps what each stage ends with."""

    index: ClassVar[str]  # the CSV's name for a snapshot's count

    def __init__(self, seeds: Sequence[int], tasks: Sequence[Any]) -> None:
        self.seeds, self.tasks, self.target = seeds, tasks, tasks[-1]
        self.kept: list[Any] = []  # by stage, recorded at its end; checkpoints store it
        #: Seeds, by index, that can't continue after the latest measurement, and why.
        self.failed: dict[int, str] = {}

    def measure(self, snapshot: Any) -> list[dict[str, float]]:
        """Each seed's metrics."""
        raise NotImplementedError

    def rows(self, snapshot: Snapshot) -> list[dict[str, float]]:
        """Each seed's row: stage, task and count, metrics, and the scale of its base.

        The scale has columns only in runs that change it.
        """
        stage, found = snapshot.stage, snapshot.searched
        place = {"stage": stage.number, "task": stage.task, self.index: snapshot.count}
        rows: list[dict[str, float]] = [place | own for own in self.measure(snapshot)]
        if stage.boost.alpha != 1.0:
            found = found or Searched.fixed(np.nan, len(rows))
            for row, *scale in zip(
                rows, found.alpha.tolist(), found.base_fit.tolist(), strict=True
            ):
                row |= zip(SCALE, scale, strict=True)
        return rows

    def shown(self, episodes: rollout.Episodes, s: int, e: int) -> dict[str, NDArray]:
        """Episode e of the seed with index s, and the scene, as the NPZ stores them."""
        length, target = episodes.length[s, e], self.target
        found = {
            "trajectory": episodes.state[s, e, : length + 1],  # (T + 1, d)
            "trajectory_actions": episodes.action[s, e, :length],  # (T,) or (T, k)
            "trajectory_start": episodes.start[s, e],  # what reset a simulator
        }
        if hasattr(target, "walls"):
            walls = np.stack([task.walls for task in self.tasks])
            return found | {"walls": walls, "goal": target.goal}
        return found | (target.scene() if hasattr(target, "scene") else {})


class Probe(SeedProbe):
    """Measures FQI's iterations in their tasks; draws from the evaluation streams."""

    index = "iteration"

    def __init__(
        self, seeds: Sequence[int], tasks: Sequence[Env], metrics: Sequence[str]
    ) -> None:
        super().__init__(seeds, tasks)
        self.metrics, self.states = metrics, probed_states(self.target)
        self.compares = needs_reference(metrics)
        start, reference, q_star = _layout(self.target, self.target, self.compares)
        known = len(start) == 1 and (reference == start).any()
        #: V*(s0) of the target, if the oracle knows the only evaluation state.
        self.optimum = float(q_star[reference == start].max()) if known else None

    def measure(self, snapshot: Iteration) -> list[dict[str, float]]:
        """Each seed's metrics; only a simulator's episodes have random starts."""
        env = snapshot.stage.env
        rngs = [stream(seed, "evaluation", snapshot.count) for seed in self.seeds]
        if is_simulated(env):
            start, u = rollout.starts_and_draws(rngs, env, env.starts)
        else:
            start = np.stack([env.evaluation_states()] * len(rngs))
            u = rollout.draws(rngs, env, start.shape[1])
        episodes = rollout.rollout(env, snapshot.result.q, start, u)
        self.failed = episodes.failed | snapshot.failed
        if snapshot.last_of_stage:
            self.kept.append(snapshot.probed_residual)
            self._last = snapshot
        returns = episodes.discounted_return(env.gamma)
        solved = episodes.solved(rollout.success_of(env))
        learned = (snapshot.probed_q, snapshot.probed_residual, returns, solved)
        known = (*_layout(env, self.target, self.compares), self.optimum)
        rows = []
        for s, outcome in enumerate(zip(*learned, strict=True)):
            view = View(*outcome, *known)
            row = {name: float(METRICS[name](view)) for name in self.metrics}
            rows.append(dict.fromkeys(row, np.nan) if s in self.failed else row)
        return rows

    def arrays(self, s: int) -> dict[str, NDArray]:
        """The NPZ of the seed with index s: what it learned, an episode, the scene."""
        residuals = np.stack([residual[s] for residual in self.kept])
        found = {"states": self.states, "q": self._last.probed_q[s]}
        return found | {"residuals": residuals} | self.shown(self._episodes, s, 0)

    @cached_property
    def _episodes(self) -> rollout.Episodes:
        """A greedy episode in the target task, the evaluation's if it has only one."""
        rngs = [stream(seed, "evaluation", self._last.count) for seed in self.seeds]
        start, u = rollout.starts_and_draws(rngs, self.target, 1)
        episodes = rollout.rollout(self.target, self._last.result.q, start, u)
        self.failed = episodes.failed | self.failed
        return episodes

    def facts(self) -> dict[str, Any]:
        """What the metadata says about the measurements."""
        return {"optimum": self.optimum}


@lru_cache(maxsize=64)
def probed_states(target: Env) -> Floats:
    """All states of an env that lists them, else those that metrics need, (n, d)."""
    if hasattr(target, "states"):
        return target.states()
    return np.unique(target.evaluation_states(), axis=0)


@lru_cache(maxsize=64)
def _layout(env: Env, target: Env, compares: bool) -> tuple[Integers, Integers, Floats]:
    """Rows of the start states and of Q*'s states among the probed ones, and Q*."""
    states = probed_states(target)

    def rows(of: Floats) -> Integers:
        match = (of[:, None] == states[None]).all(-1)
        if not match.any(1).all():
            raise BcrlError(f"{env}: its evaluation states are not the target's")
        return match.argmax(1)

    # A simulator's starts are random: Q is recorded where the target may start.
    start = rows((target if is_simulated(env) else env).evaluation_states())
    # A single start state has a known optimum, which the metadata names.
    if not (compares or len(start) == 1) or (known := oracle.reference(env)) is None:
        return start, np.empty(0, np.intp), np.empty((0, env.n_actions))
    return start, rows(known.states), known.q
