"""Long task sequences with and without folding: acting, memory, agents, returns.

    python bench/folding.py [maze] [hill] [point_mass]

Each kind is learned with 1 (plain), 10, 40 and 100 tasks, `boosting.fold` never and
always. Acting is one greedy action at one state, the least of several turns; memory is
that of all arrays of an agent. Two seeds in hill and point mass, 20 in the maze.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

import bcrl
from bcrl.config import flags, jobs
from bcrl.config.plan import Plan
from bcrl.results.layout import AGENT, seed_path
from bcrl.results.tables import read_results
from bcrl.run import runner

TASKS = (1, 10, 40, 100)
#: The maze's budget in the paper, by tenths of the sequence.
ITERATIONS = (10, 10, 10, 10, 20, 20, 50, 50, 50, 50)
EPSILON = (1.0, 1.0, 1.0, 1.0, 0.75, 0.75, 0.5, 0.5, 0.25, 0.25)
FOLDS = ("never", "always")


def spread(low: float, high: float, n: int) -> str:
    """n values from low to high as a list on the command line; the last is high."""
    values = np.linspace(low, high, n) if n > 1 else [high]
    return f"[{','.join(f'{x:.6g}' for x in values)}]"


def stretched(values: Sequence[float], n: int) -> str:
    """The values of ten slots as those of n, the last one's if n is 1."""
    found = [values[10 * i // n] for i in range(n)] if n > 1 else [values[-1]]
    return f"[{','.join(map(str, found))}]"


def words(kind: str, n: int) -> list[str]:
    """What a command says for n tasks."""
    if kind == "maze":
        own = [f"env.tasks.height={spread(0.05, 0.95, n)}", "seeds.count=20"]
        own += ["workers=2", f"algorithm.iterations={stretched(ITERATIONS, n)}"]
        return ["env=maze", *own, f"algorithm.epsilon={stretched(EPSILON, n)}"]
    if kind == "hill":
        own = [f"env.tasks.mass={spread(0.8, 1.2, n)}", "algorithm.iterations=5"]
        return ["env=car_on_hill", *own, "algorithm.episodes=200", "seeds.count=2"]
    same = {"task": "target", "horizon": 150}
    own = [f"env.tasks.{k}=[{','.join([str(x)] * n)}]" for k, x in same.items()]
    own += ["~env.drift", f"+env.tasks.drift={spread(0.0, -0.5, n)}"]
    own += ["algorithm=dqn", "algorithm.steps=1000", "algorithm.target_update=200"]
    own += ["algorithm.evaluate_every=1000", "algorithm.evaluation_episodes=34"]
    return ["env=linear_system", *own, "seeds.count=2"]


def trained(folder: str, kind: str, n: int, fold: str) -> tuple[Plan, float]:
    """A run's plan, and its seconds."""
    given = [*words(kind, n), f"runs_dir={folder}", "progress=none", "tag=x"]
    given += ["variant=plain"] if n == 1 else ["variant=BC", f"boosting.fold={fold}"]
    sys.argv = ["bcrl", *given]
    (plan,) = jobs.plans(flags.arguments())
    began = time.perf_counter()
    runner.run(plan)
    return plan, time.perf_counter() - began


def acting(plan: Plan, turns: int = 5, actions: int = 50) -> float:
    """Microseconds of a greedy action."""
    agent, seconds = bcrl.load(plan.directory, 0), []
    state = plan.target.evaluation_states()[0]
    for _ in range(turns):
        began = time.perf_counter()
        for _ in range(actions):
            agent.act(state)
        seconds.append((time.perf_counter() - began) / actions)
    return 1e6 * min(seconds)


def held(thing: Any, seen: set[int] | None = None) -> int:
    """Bytes of the arrays that an object has, each counted once."""
    seen = set() if seen is None else seen
    if id(thing) in seen:
        return 0
    seen.add(id(thing))
    if hasattr(thing, "nbytes"):
        return int(thing.nbytes)
    parts: Any = ()
    if isinstance(thing, (list, tuple)):
        parts = thing
    elif type(thing).__module__.startswith(("bcrl.learning", "bcrl.q")):
        parts = vars(thing).values()
    return sum(held(part, seen) for part in parts)


def row(kind: str, n: int, fold: str) -> str:
    """A line of the table."""
    with tempfile.TemporaryDirectory() as folder:
        plan, seconds = trained(folder, kind, n, fold)
        size = seed_path(plan.directory, 0, AGENT).stat().st_size
        memory = held(bcrl.load(plan.directory, 0).learned) / 2**20
        last = read_results(plan.directory).groupby("seed").last()
        facts = json.loads(seed_path(plan.directory, 0, "json").read_text())
        returns, optimum = last["return"], facts.get("optimum")
        good = "" if optimum is None else f"{(returns >= optimum - 1e-3).mean():.0%}"
        folds = [*facts.get("fold", {}).values()]
        changed = max((x["greedy_changed"] for x in folds), default=0.0)
        notes = sum("note" in x for x in folds)
        cells = (kind, n, fold if n > 1 else "–", f"{acting(plan):.0f}")
        cells += (f"{memory:.1f}", f"{size / 2**20:.2f}", f"{seconds:.0f}")
        cells += (f"{returns.mean():.4g}", good, f"{changed:.3f}", notes)
    return "| " + " | ".join(map(str, cells)) + " |"


def main(kinds: Sequence[str]) -> None:
    names = "kind, tasks, fold, act µs, memory MiB, agent MiB, run s, return, optimal, "
    names += "most greedy actions changed, losses missed"
    columns = names.split(", ")
    print("| " + " | ".join(columns) + " |")
    print("|" + "---|" * len(columns))
    for kind in kinds or ("maze", "hill", "point_mass"):
        for n in TASKS:
            for fold in FOLDS if n > 1 else FOLDS[:1]:
                print(row(kind, n, fold), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
