"""Tables for the terminal: what a command would run, what is done, what it cost."""

from __future__ import annotations

import math
from argparse import Namespace
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from bcrl.common.identity import Plain
from bcrl.common.terminal import aligned
from bcrl.config import jobs
from bcrl.config.plan import Plan
from bcrl.errors import BcrlError
from bcrl.results.layout import (
    COMPLETE,
    CONFIG,
    FAILED,
    recorded_seeds,
    requested,
    spelled,
)
from bcrl.results.read import read_document
from bcrl.run import checkpoints, costs, records
from bcrl.run.records import STATES
from bcrl.run.schedule import Failures, merged, ordered


def dry_run(plans: Sequence[Plan]) -> str:
    """The jobs that these plans would be now, and their expected costs."""
    plans, failed = merged(plans), Failures()
    jobs = ordered(plans, failed)
    seconds = [job.seconds * (1.0 - job.done) for job in jobs]
    rows = [("", "complete", "to do", "jobs", "core min")]
    for plan in plans:
        own = [n for n, job in enumerate(jobs) if job.plan is plan]
        todo = spelled([seed for n in own for seed in jobs[n].seeds])
        done = str(len(plan.seeds) - len(records.pending(plan)))
        cost = _minutes(sum(seconds[n] for n in own))
        rows.append((str(plan.directory), done, todo, str(len(own)), cost))
    damaged = [line for p in plans for line in damage(p.directory, p.seeds)]
    hopeless = [why for reasons in failed.values() for why in set(reasons.values())]
    workers = plans[0].config["workers"]
    wall = _minutes(costs.makespan(seconds, workers))
    total = f"{len(jobs)} jobs, about {_minutes(sum(seconds))} core minutes"
    last = f"{total}, {wall} min with workers={workers}; nothing was run or written"
    return "\n".join([*aligned(rows), *damaged, *hopeless, last])


def status(arguments: Namespace) -> str:
    """The state of all seeds of a command line, as a table.

    If it names nothing but `runs_dir`, of all seeds that were ever requested there.
    """
    if all(override.startswith("runs_dir=") for override in arguments.overrides):
        any_ = [*arguments.overrides, "env=maze"]  # it is a required choice
        (plan,) = jobs.plans(Namespace(**vars(arguments) | {"overrides": any_}))
        folders = sorted(path.parent for path in plan.root.glob(f"*/*/*/{CONFIG}"))
        if not folders:
            raise BcrlError(f"runs_dir={plan.root}: holds no runs")
        asked = [(folder, _ever_requested(folder), math.nan) for folder in folders]
    else:
        plans = merged(jobs.plans(arguments))
        asked = [(p.directory, p.seeds, costs.expected(p)) for p in plans]
    rows, total, reasons = [["", "seeds", *STATES, "done", "core min left"]], 0.0, []
    for directory, seeds, expected in asked:
        facts = {seed: records.read_facts(directory, seed) for seed in seeds}
        states = {seed: records.state(directory, seed) for seed in seeds}
        failed = {s: facts[s]["status"] for s in seeds if states[s] == FAILED}
        undone, left = _left(directory, facts, states, expected)
        counts = Counter(states.values())
        cells = [str(counts[state] or "") for state in STATES]
        done = f"{100 * (1 - (undone + len(failed)) / max(1, len(seeds))):.0f} %"
        name = " ".join(directory.parts[-3:])
        rows.append([name, str(len(seeds)), *cells, done, _minutes(left)])
        total += left
        for why, lost in records.by_reason(failed):
            reasons.append(f"{name}, {records.named(lost)}: {why}")
        reasons += damage(directory, seeds)
    rows.append(["in all", *[""] * (len(STATES) + 2), _minutes(total)])
    return "\n".join([*aligned(rows), *reasons])


def _left(
    directory: Path, facts: Mapping[int, Plain], states: Mapping[int, str], each: float
) -> tuple[float, float]:
    """The work that is left, in seeds and in core-seconds; NaN: unknown.

    Without seeds that failed. A seed takes the mean of the complete ones, or `each`.
    """
    begun = checkpoints.shares(directory)
    over = (COMPLETE, FAILED)
    undone = sum(1.0 - begun.get(s, 0.0) for s in states if states[s] not in over)
    done = [s for s in states if states[s] == COMPLETE]
    if done:
        each = sum(facts[s].get("cpu_seconds", 0) for s in done) / len(done)
    return undone, undone * each if undone else 0.0


def damage(directory: Path, seeds: Sequence[int]) -> Iterator[str]:
    """A line for each way in which files of finished seeds are damaged."""
    for why, lost in records.by_reason(records.damaged(directory, seeds)):
        name = f"{' '.join(directory.parts[-3:])}, {records.named(lost)}"
        yield f"{name}: {why}; a rerun makes {'them' if lost[1:] else 'it'} again"


def closing_lines(plans: Sequence[Plan], seconds: float) -> Iterator[str]:
    """After a run: which variants diverge, and a table of the costs of several plans.

    `seconds`: wall-clock time of this call.
    """
    rows = [("", "seeds", "failed", "CPU s per seed", "core min")]
    total = peak = 0.0
    for plan in plans:
        facts = {seed: records.read_facts(plan.directory, seed) for seed in plan.seeds}
        name = f"{plan.env} {plan.name}"
        lost = [seed for seed in facts if facts[seed].get("diverging")]
        if lost:
            which = sorted({key for seed in lost for key in facts[seed]["diverging"]})
            yield f"{name}, {records.named(lost)}: {', '.join(which)} diverges"
        spent = [
            each["cpu_seconds"] for each in facts.values() if "cpu_seconds" in each
        ]
        failed = sum(each.get("status") != COMPLETE for each in facts.values())
        total += sum(spent)
        peak = max(peak, *(each.get("peak_memory_mib", 0.0) for each in facts.values()))
        mean = f"{sum(spent) / max(1, len(spent)):.2f}"
        rows.append((name, str(len(facts)), str(failed), mean, _minutes(sum(spent))))
    if len(plans) > 1:
        yield from aligned([*rows, ("in all", "", "", "", _minutes(total))])
        call = f"this call: {_minutes(seconds)} min"
        memory = f"peak memory of a process that trains: {peak:.0f} MiB"
        yield f"{call} with workers={plans[0].config['workers']}; {memory}"


def _ever_requested(directory: Path) -> list[int]:
    """The seeds that were ever requested of a variant, by the JSON of begun ones."""
    seeds: set[int] = set()
    for number in recorded_seeds(directory, "json"):
        with suppress(BcrlError):  # a damaged JSON
            seeds |= requested(read_document(directory, number))
    return sorted(seeds)


def _minutes(seconds: float) -> str:
    return "?" if math.isnan(seconds) else f"{seconds / 60:.1f}"
