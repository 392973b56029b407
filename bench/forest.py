"""Times of the forest engine against scikit-learn's, one core: python bench/forest.py

First 10³, 10⁴ and 10⁵ rows (--million: 10⁶ too) of 1 to 32 features, as many queries
and 10 trees, with the paper's settings and scikit-learn's defaults. Then the paper's
two environments with 50 trees. Hill: 29 000 rows of (position, velocity), 58 000 query
rows (each successor under two actions' forests). Maze: an iteration of 100 000
transitions, one forest for each of 4 actions, at most 441 distinct rows in each, 441
query rows. The maze stands in two lines: scikit-learn has no multiplicities, so that it
fits all rows in both; its user may predict at the 441 distinct successors only, as we
do, or at all 100 000 as they come.
Both sides are timed by turns and equally often, CPU time, the least of several.
"""

from __future__ import annotations

import sys

import numpy as np
from sklearn.ensemble import ExtraTreesRegressor
from threadpoolctl import threadpool_limits
from timing import by_turns

from bcrl.q.forest.forest import Regression, TreeSettings, fit_forests

TREES = 50
PAPER = TreeSettings(min_samples_split=5, min_samples_leaf=2)


def judge(trees: int = TREES) -> ExtraTreesRegressor:
    return ExtraTreesRegressor(
        trees, min_samples_split=5, min_samples_leaf=2, n_jobs=1, random_state=0
    )


def seeds() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 2**64, TREES, dtype=np.uint64)


def hill(n: int, key: int) -> tuple[np.ndarray, np.ndarray]:
    """States and values like the car's: discounted ±1 in curved bands, and noise."""
    rng = np.random.default_rng(key)
    x = rng.uniform([-1, -3], [1, 3], (n, 2)).astype(np.float32)
    p, v = x.T.astype(float)
    steps = np.floor(12 * (1 - p) + 3 * np.abs(v - np.sin(3 * p)))
    y = np.where(v > np.sin(3 * p) - 1, 0.95**steps, -(0.95**steps))
    return x, y + rng.normal(0, 0.02, n)


def features(n: int, d: int) -> None:
    """Print how many times as fast as scikit-learn we fit and predict, two settings."""
    rng = np.random.default_rng([n, d])
    x, queries = rng.uniform(-1, 1, (2, n, d)).astype(np.float32)
    y = np.sin(4 * x[:, 0]) + (x[:, -1] > 0.2) * x[:, d // 2] + rng.normal(0, 0.2, n)
    print(f"{n:9} rows, {d:2} features", end="")
    for settings in (PAPER, TreeSettings()):
        model = judge(trees := 10).set_params(
            min_samples_split=settings.min_samples_split,
            min_samples_leaf=settings.min_samples_leaf,
        )
        task = Regression(x, y, seeds()[:trees])
        forest = fit_forests([task], settings)[0].forest
        model.fit(x, y)
        calls = [
            lambda model=model: model.fit(x, y),
            lambda model=model: model.predict(queries),
            lambda task=task, given=settings: fit_forests([task], given),
            lambda forest=forest: forest.predict(queries),
        ]
        turns = 15 if n <= 10**4 else 3  # short calls need more of them
        fit, predict, ours, ours_predict = by_turns(calls, turns)
        print(f"{fit / ours:9.1f}×{predict / ours_predict:9.1f}×", end="", flush=True)
    print()


def paper() -> None:
    x, y = hill(29_000, 0)
    queries, _ = hill(58_000, 1)
    model, task = judge(), Regression(x, y, seeds())
    carried = Regression(x, y, seeds(), None, queries)
    forest = fit_forests([task], PAPER)[0].forest
    model.fit(x, y)
    fit, predict, ours, ours_predict, ours_both = by_turns(
        [
            lambda: model.fit(x, y),
            lambda: model.predict(queries),
            lambda: fit_forests([task], PAPER),
            lambda: forest.predict(queries),
            lambda: fit_forests([carried], PAPER, keep=False),
        ],
        turns=5,
    )

    rng = np.random.default_rng(2)
    cells = np.stack(np.meshgrid(np.arange(21), np.arange(21)), -1).reshape(-1, 2) / 20
    counts = rng.multinomial(25_000, rng.dirichlet(np.ones(441)), size=4)
    value = -20 * np.abs(cells - 0.95).sum(1)
    distinct, repeated = [], []
    grid = cells.astype(np.float32)
    for count in counts:
        seen = count > 0
        target = value[seen] + rng.normal(0, 0.1, seen.sum())
        distinct.append(Regression(grid[seen], target, seeds(), count[seen], grid))
        some = count[seen]
        repeated.append((np.repeat(grid[seen], some, 0), np.repeat(target, some)))
    fit_forests(distinct, PAPER, keep=False)

    successors = np.concatenate([rows for rows, _ in repeated])

    def scikit_learn_distinct() -> None:
        for rows, target in repeated:
            judge().fit(rows, target).predict(grid)

    def scikit_learn_all() -> None:
        for rows, target in repeated:
            judge().fit(rows, target).predict(successors)

    def ours_maze() -> None:
        fit_forests(distinct, PAPER, keep=False)

    distinct_time, all_time, mine_maze = by_turns(
        [scikit_learn_distinct, scikit_learn_all, ours_maze], turns=5
    )

    print(f"{'per tree, one core':38}{'scikit-learn':>14}{'ours':>12}{'ratio':>8}")
    for name, theirs, mine in (
        ("hill: fit 29 000 rows", fit, ours),
        ("hill: predict 58 000 rows", predict, ours_predict),
        ("hill: fit + predict while growing", fit + predict, ours_both),
        ("maze: predict distinct successors", distinct_time / 4, mine_maze / 4),
        ("maze: predict all 100 000 successors", all_time / 4, mine_maze / 4),
    ):
        times = f"{theirs / TREES * 1e3:11.3f} ms{mine / TREES * 1e3:9.4f} ms"
        print(f"{name:38}{times}{theirs / mine:7.1f}×")


def main() -> None:
    print(
        "times as fast as scikit-learn    paper: fit   predict  defaults: fit predict"
    )
    for n in (10**3, 10**4, 10**5, *([10**6] if "--million" in sys.argv else [])):
        for d in (1, 2, 4, 8, 16, 32):
            features(n, d)
    paper()


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
