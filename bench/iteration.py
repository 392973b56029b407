"""One FQI iteration, ours against the plain way, one core: python bench/iteration.py

The plain way keeps every transition as it came: scikit-learn's forest a action, fitted
to all rows, predicts all next states. Ours is the learner's own iteration. Both compute
targets, fits and values at all next states from the same data, by turns; the least time
of each counts.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from sklearn.ensemble import ExtraTreesRegressor
from threadpoolctl import threadpool_limits

from bcrl.envs import Env
from bcrl.envs.car_on_hill import CarOnHill
from bcrl.envs.maze import Maze
from bcrl.evaluation.metrics import probed_states
from bcrl.learning import bellman
from bcrl.learning.fqi import FQI, Iteration
from bcrl.learning.stage import SeedBatch, Stage, learn
from bcrl.q.regressors.ours import ForestRegressor


class Plain:
    """The plain way: arrays of all transitions, one scikit-learn forest an action."""

    def __init__(self, env: Env, seen: Iteration) -> None:
        (d,) = seen.result.data
        again = np.repeat(np.arange(len(d.state)), d.multiplicity)
        self.env, self.action = env, d.action[again]
        self.reward, self.absorbing = d.reward[again], d.absorbing[again]
        self.states = d.points[d.state[again]]
        self.after = d.points[d.next_state[again]]
        self.next_q = np.zeros((len(again), env.n_actions))

    def iterate(self) -> None:
        base = np.zeros(len(self.reward))
        y = bellman.residual_target(
            self.reward, self.absorbing, self.next_q, base, self.env.gamma
        )
        for a in range(self.env.n_actions):
            forest = ExtraTreesRegressor(50, min_samples_split=5, min_samples_leaf=2)
            forest.fit(self.states[self.action == a], y[self.action == a])
            self.next_q[:, a] = forest.predict(self.after)


def compare(name: str, env: Env, episodes: int, repeats: int) -> None:
    """Print one row: transitions, ms of both, ratio, after a few iterations each."""
    learner = FQI(10**9, episodes, ForestRegressor())
    stage = Stage(1, 1, env, learner, (), 0)
    ours = learn([stage], SeedBatch((0,), probed_states(env)))
    plain = Plain(env, next(ours))  # the first collects the data and compiles
    plain.iterate()
    steps: list[Callable[[], object]] = [plain.iterate, lambda: next(ours)]
    best = [np.inf, np.inf]
    for _ in range(repeats):
        for i, step in enumerate(steps):
            for _ in range(1 + 4 * i):  # both get a comparable share of the time
                began = time.perf_counter()
                step()
                best[i] = min(best[i], time.perf_counter() - began)
    a, b = best
    n = len(plain.reward)
    print(f"{name:12}{n:12}{a * 1e3:15.1f}{b * 1e3:10.2f}{a / b:9.1f}x")


def main() -> None:
    head = f"{'task':12}{'transitions':>12}{'plain, ms':>15}{'ours, ms':>10}"
    print(f"{head}{'ratio':>10}")
    with threadpool_limits(1):
        compare("maze T1", Maze(height=0.05), 500, 3)
        compare("maze T10", Maze(height=0.95), 500, 3)
        compare("hill 1.2 kg", CarOnHill(mass=1.2), 1000, 3)


if __name__ == "__main__":
    main()
