"""What kept agents cost: size, time to load and to act, share of a run's time.

One seed per method, at the paper's budgets, with the usual keep=final. `keeping` is
the time in which the run packs and writes the agent's file, flushing to disk included.
Loading is the least of three times in a process that has imported everything.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import bcrl
from bcrl.common import files
from bcrl.config import flags, jobs
from bcrl.config.plan import Plan
from bcrl.results.layout import AGENT, seed_path
from bcrl.run import job, runner

BOTH, DQN = ("plain", "C", "B", "BC"), "algorithm=dqn"
CHOICES = {
    "car on the hill": (("env=car_on_hill",), BOTH),
    "maze": (("env=maze",), BOTH),
    "linear system": (
        ("env=linear_system", DQN),
        ("plain", "C", "BC", "SC", "SBC", "RPL", "PPR"),
    ),
    "CartPole-v1, FQI": (("env=cart_pole",), ("C", "BC")),
    "CartPole-v1, DQN": (("env=cart_pole", DQN), ("C", "SBC")),
}


def timed(call: Callable[..., Any], spent: list[float]) -> Callable[..., Any]:
    """The same function, whose seconds are added to `spent` for agents' files."""

    def measured(*given: Any) -> Any:
        began = time.perf_counter()
        found = call(*given)
        if not isinstance(given[0], Path) or given[0].suffix == f".{AGENT}":
            spent.append(time.perf_counter() - began)
        return found

    return measured


def trained(*words: str) -> tuple[Plan, float]:
    """A run's plan, and the seconds in which it has packed and written its agent."""
    sys.argv = ["bcrl", *words, "seeds.count=1", "progress=none"]
    (plan,) = jobs.plans(flags.arguments())
    usual, spent = (job.packed, files.write_bytes), list[float]()
    job.packed, files.write_bytes = (timed(call, spent) for call in usual)
    try:
        runner.run(plan)
    finally:
        job.packed, files.write_bytes = usual
    return plan, sum(spent)


def least(call: Callable[[], object], turns: int = 3) -> float:
    """The least seconds of some calls."""
    every = []
    for _ in range(turns):
        began = time.perf_counter()
        call()
        every.append(time.perf_counter() - began)
    return min(every)


def measured(words: tuple[str, ...]) -> str:
    """The cells of a run: method, size, times, share."""
    with tempfile.TemporaryDirectory() as folder:
        plan, keeping = trained(*words, f"runs_dir={folder}")
        facts = json.loads(seed_path(plan.directory, 0, "json").read_text())
        size = seed_path(plan.directory, 0, AGENT).stat().st_size
        load = least(lambda: bcrl.load(plan.directory))
        agent = bcrl.load(plan.directory)
        states = np.load(seed_path(plan.directory, 0, "npz"))["states"][:50]
        act = least(lambda: [agent.act(state) for state in states]) / len(states)
    run = facts["wall_seconds"]
    cells = f"{size / 1e6:.2f} MB", f"{1e3 * load:.0f} ms", f"{1e6 * act:.0f} µs"
    share = f"{100 * keeping / run:.2f} %"
    return " | ".join(
        [plan.variant, *cells, f"{run:.1f} s", f"{1e3 * keeping:.0f} ms", share]
    )


def main(*tasks: str) -> None:
    print("| task | method | size | load | act | run | keeping | share |")
    print("|---|---|---|---|---|---|---|---|")
    for task in tasks or CHOICES:
        words, variants = CHOICES[task]
        for variant in variants:
            cells = measured((*words, f"variant={variant}"))
            print(f"| {task} | {cells} |", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
