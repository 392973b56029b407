"""Two tables that write nothing: what a command line would run, and what is done."""

from __future__ import annotations

import heapq
import math
from argparse import Namespace
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bcrl.common import files
from bcrl.config import jobs
from bcrl.config.plan import Plan
from bcrl.errors import BcrlError
from bcrl.run import checkpoints, costs, locks, records, runner
from bcrl.run.progress import named

COMPLETE, RUNNING, FAILED = "complete", "running", "failed"  # as in a seed's JSON
INTERRUPTED, WAITING = "interrupted", "waiting"
MOST = 10**6  # seeds in one range; a config can't ask for more
STATES = (COMPLETE, RUNNING, INTERRUPTED, FAILED, WAITING)


def dry_run(plans: Sequence[Plan]) -> str:
    """The jobs that these plans would be now, and what they are expected to cost."""
    plans, failed = list(runner.merged(plans)), {}
    work = runner.ordered(plans, failed)
    begun = {plan.directory: checkpoints.teams(plan) for plan, _ in work}
    seconds = []  # of one core, of each job
    for plan, seeds in work:
        left = 1.0 - begun[plan.directory].get(seeds, 0.0)
        seconds.append(costs.expected(plan) * len(seeds) * left)
    rows = [("", "complete", "to do", "jobs", "core min")]
    for plan in plans:
        jobs = [n for n, (of, _) in enumerate(work) if of is plan]
        todo = [seed for n in jobs for seed in work[n][1]]
        done = str(len(plan.seeds) - len(records.pending(plan)))
        cost = _minutes(sum(seconds[n] for n in jobs))
        where, which = str(plan.directory), _seeds(todo)
        rows.append((where, done, which, str(len(jobs)), cost))
    hopeless = [why for lost in failed.values() for why in set(lost.why.values())]
    workers = plans[0].config["workers"]
    wall = _minutes(_wall(seconds, workers))
    total = f"{len(work)} jobs, about {_minutes(sum(seconds))} core minutes"
    last = f"{total}, {wall} min with workers={workers}; nothing was run or written"
    damaged = [x for plan in plans for x in runner.damage(plan.directory, plan.seeds)]
    return "\n".join([*_aligned(rows), *damaged, *hopeless, last])


def _wall(seconds: Sequence[float], workers: int) -> float:
    """When the last of the jobs is done that `workers` take in this order."""
    free = [0.0] * workers
    for job in seconds:
        heapq.heapreplace(free, free[0] + job)
    return max(free)


@dataclass(frozen=True)
class Asked:
    """Seeds of a variant that were asked for, and where each stands."""

    directory: Path
    states: dict[int, str]  # by seed: one of `STATES`
    failed: dict[int, str]  # why
    undone: float  # seeds' worth of work that is left, but for those that failed
    seconds: float  # of one core, that this work is expected to take; NaN: unknown

    @property
    def name(self) -> str:
        """`paper maze BC-FQI`."""
        return " ".join(self.directory.parts[-3:])


def status(arguments: Namespace) -> str:
    """How far everything is that a command line asks for.

    If it names nothing but `runs_dir`, everything that was ever begun there.
    """
    if all(override.startswith("runs_dir=") for override in arguments.overrides):
        any_ = [*arguments.overrides, "env=maze"]  # it is a required choice
        (plan,) = jobs.plans(Namespace(**vars(arguments) | {"overrides": any_}))
        root = plan.root
        folders = sorted(path.parent for path in root.glob("*/*/*/config.yaml"))
        if not folders:
            raise BcrlError(f"runs_dir={root}: holds no runs")
        variants = [_measure(folder, _ever_asked(folder)) for folder in folders]
    else:
        plans = runner.merged(jobs.plans(arguments))
        variants = [_measure(p.directory, p.seeds, costs.expected(p)) for p in plans]
    rows = [("", "seeds", *STATES, "done", "core min left")]
    for asked in variants:
        counts, n = Counter(asked.states.values()), len(asked.states)
        done = f"{100 * (1 - (asked.undone + len(asked.failed)) / max(1, n)):.0f} %"
        cells = [str(counts[state] or "") for state in STATES]
        rows.append((asked.name, str(n), *cells, done, _minutes(asked.seconds)))
    total = sum(asked.seconds for asked in variants)
    rows.append(("in all", *[""] * (len(STATES) + 2), _minutes(total)))
    reasons = [line for asked in variants for line in _reasons(asked)]
    return "\n".join([*_aligned(rows), *reasons])


def _ever_asked(directory: Path) -> list[int]:
    """The seeds that a variant's folder was ever asked for, by what those begun say."""
    seeds: set[int] = set()
    for number in files.seeds_of(directory, "json"):
        try:
            for first, last in records.read_facts(directory, number)["asked"]:
                seeds.update(range(first, min(last, first + MOST) + 1))
        except records.MALFORMED:
            continue
    return sorted(seeds)


def _measure(directory: Path, seeds: Sequence[int], seconds: float = math.nan) -> Asked:
    """Where a variant's seeds stand; one is expected to take so many core-seconds.

    What those that are complete took counts more.
    """
    facts = {seed: records.read_facts(directory, seed) for seed in seeds}
    states = {seed: _state(directory, seed, facts[seed]) for seed in seeds}
    failed = {s: facts[s]["status"] for s in seeds if states[s] == FAILED}
    spent = [facts[s].get("cpu_seconds", 0) for s in seeds if states[s] == COMPLETE]
    begun = checkpoints.shares(directory)
    left = [s for s in seeds if states[s] not in (COMPLETE, FAILED)]
    undone = sum(1.0 - begun.get(seed, 0.0) for seed in left)
    rate = sum(spent) / len(spent) if spent else seconds
    return Asked(directory, states, failed, undone, undone * rate if undone else 0.0)


def _state(directory: Path, seed: int, facts: Mapping[str, Any]) -> str:
    """One of `STATES`; what says `running` but has no lock was interrupted."""
    if locks.is_held(directory, seed):
        return RUNNING
    if records.is_complete(directory, seed):
        return COMPLETE
    said = str(facts.get("status", WAITING))
    if said.startswith(FAILED):
        return FAILED
    return INTERRUPTED if said == RUNNING else WAITING


def _reasons(asked: Asked) -> Iterator[str]:
    """A line for each reason why seeds have failed, or count no more."""
    for why in dict.fromkeys(asked.failed.values()):
        lost = [seed for seed, reason in asked.failed.items() if reason == why]
        yield f"{asked.name}, {named(lost)}: {why}"
    yield from runner.damage(asked.directory, list(asked.states))


def _minutes(seconds: float) -> str:
    return "?" if math.isnan(seconds) else f"{seconds / 60:.1f}"


def _seeds(seeds: Sequence[int]) -> str:
    """`0–2, 5`."""
    ranges = records.ranges(seeds)
    return ", ".join(f"{a}–{b}" if a < b else str(a) for a, b in ranges)


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows as lines: the first column to the left, all others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        row[0].ljust(widths[0])
        + "".join(f"  {cell:>{w}}" for cell, w in zip(row[1:], widths[1:], strict=True))
        for row in rows
    ]
