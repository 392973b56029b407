"""How an FQI iteration's cost grows, one core: python bench/growth.py

First with the residual's number: on one dataset of the hill a stage learns its first
residual, on nothing, or its 40th, on a frozen base of 39. The base's values at the
points are computed once a stage and printed apart. Second acting: the values of 1 and
of 10 residuals at 20 states, as an episode's step queries them. Third with the episodes
of the dataset and with the number of seeds in lockstep. An iteration is targets, fits
and values at all points; evaluation is not in it. All by turns, CPU time, the least of
several iterations after early ones, whose targets take few values and give small trees.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import timing
from threadpoolctl import threadpool_limits

from bcrl.envs.car_on_hill import CarOnHill
from bcrl.evaluation.metrics import probed_states
from bcrl.learning.fqi import FQI, Iteration
from bcrl.learning.stage import SeedBatch, Stage
from bcrl.learning.transfer import StageInit, begin
from bcrl.q.functions import Q, Sum
from bcrl.q.regressors.ours import ForestRegressor

ENV, RESIDUAL, EARLY, TURNS = CarOnHill(mass=1.2), 40, 11, 6


def stage(episodes: int, reuse: bool = False) -> Stage:
    """A stage of endless iterations, on the data of the stage before if `reuse`."""
    learner = FQI(10**9, episodes, ForestRegressor(), new_data=not reuse)
    return Stage(1, 1, ENV, learner, (), 0)


def iterations(
    episodes: int, seeds: int = 1, start: StageInit | None = None
) -> Iterator[Iteration]:
    """Iterations of as many seeds in lockstep, from nothing or from `start`."""
    now = stage(episodes, start is not None)
    team = SeedBatch(tuple(range(seeds)), probed_states(ENV))
    return now.learner.learn(now, start or begin((), None), team)


class Stopwatch:
    """A frozen Q, and the CPU seconds that were spent in it."""

    def __init__(self, q: Q) -> None:
        self.q, self.seconds = q, 0.0

    def __call__(self, states, n_actions):
        began = time.process_time()
        values = self.q(states, n_actions)
        self.seconds += time.process_time() - began
        return values


def by_turns(runs: list[Iterator[Iteration]]) -> list[tuple[float, float]]:
    """The least CPU milliseconds of an iteration of each, and its nodes per tree."""
    for run in runs:
        for _ in range(EARLY):
            next(run)
    best = [(np.inf, 0.0)] * len(runs)
    for _ in range(TURNS):
        for i, run in enumerate(runs):
            began = time.process_time()
            now = next(run)
            took = (time.process_time() - began) * 1e3
            forests = [f.model for own in now.result.residual.models for f in own]
            best[i] = min(best[i], (took, np.mean([np.diff(f.first) for f in forests])))
    return best


def residuals() -> None:
    """An iteration at residual 1 and at residual 40, of the same dataset."""
    *_, first = itertools.islice(iterations(1000), EARLY)
    on_one = replace(StageInit(first.result), base=first.result.q)
    run = iterations(1000, 1, on_one)
    frozen = [now.result.residual for now in itertools.islice(run, 3)]
    # 39 different residuals would take minutes to learn: three serve in turn, each
    # looked through from the root every time.
    terms = [first.result.q, *(frozen[i % 3] for i in range(RESIDUAL - 2))]
    base = Stopwatch(Sum(tuple(terms)))
    nothing = StageInit(first.result)
    starts = (nothing, replace(nothing, base=base))
    one, forty = by_turns([iterations(1000, 1, start) for start in starts])
    points = len(first.result.data[0].points)
    for number, (took, nodes) in ((1, one), (RESIDUAL, forty)):
        print(f"residual {number:2}: {took:7.1f} ms, {nodes:.0f} nodes per tree")
    print(f"ratio: {forty[0] / one[0]:.3f}")
    print(f"once per stage: base at {points} points, {base.seconds * 1e3:.0f} ms")


def acting() -> None:
    """Print the time of all actions' values at 20 states, 1 and 10 residuals."""
    learned = [now.result.residual for now in itertools.islice(iterations(250), 20)]
    states = np.random.default_rng(0).uniform([-1, -3], [1, 3], (100, 1, 20, 2))
    sums = [Sum(tuple(learned[-n:])) for n in (1, 10)]
    calls = [lambda q=q: [q(x, ENV.n_actions) for x in states] for q in sums]
    one, ten = (took / len(states) * 1e6 for took in timing.by_turns(calls, TURNS))
    print(f"acting at 20 states: {one:.0f} µs, 10 residuals {ten:.0f} µs")


def main() -> None:
    residuals()
    acting()
    sizes = [(250, 1), (500, 1), (1000, 1), (250, 2), (250, 4)]
    times = by_turns([iterations(*size) for size in sizes])
    print(f"\n{'episodes':>9}{'seeds':>7}{'ms per iteration':>17}{'nodes/tree':>12}")
    for (episodes, seeds), (took, nodes) in zip(sizes, times, strict=True):
        print(f"{episodes:9}{seeds:7}{took:17.1f}{nodes:14.0f}")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
