"""The one runner: the seeds of plans become jobs, done by processes, and records."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from bcrl.common import compiling
from bcrl.common.signals import Interrupted, Stop
from bcrl.common.terminal import say
from bcrl.config.plan import Plan
from bcrl.errors import BcrlError
from bcrl.evaluation import oracle
from bcrl.results.layout import RUNNING
from bcrl.run import checkpoints, costs, job, locks, records, status
from bcrl.run.origin import run_origin
from bcrl.run.progress import Progress, Tick
from bcrl.run.schedule import Failures, Job, merged, ordered
from bcrl.run.workers import Died, cores, do_jobs


class SeedsFailed(BcrlError):
    """Some seeds failed, all others are complete: which, why, and how to rerun them."""

    exit_code = 1


def run(*plans: Plan) -> None:
    """Compute and record every seed of the plans that is not complete yet.

    All plans share one pool of processes: jobs of a few seeds, the longest first. It
    waits for seeds that another process computes. Raises SeedsFailed at the end if
    seeds failed, Interrupted after a signal, both with everything else kept.
    """
    began, options = time.perf_counter(), plans[0].config
    quiet = options["progress"] == "none"
    plans, stop, failed = tuple(merged(plans)), Stop(), Failures()
    if not quiet and (why := compiling.why_uncached()):
        say(why)
    with stop.on_signals():
        for plan in plans:
            _prepare(plan, quiet)
        while (jobs := ordered(plans, failed)) and not stop.requested:
            _search_references([job.plan for job in jobs])
            if busy := _train(jobs, options, failed, stop):
                _wait(busy, quiet, stop)
    if jobs:
        raise Interrupted
    if not quiet:
        for line in status.closing_lines(plans, time.perf_counter() - began):
            say(line)
    if failed:
        raise SeedsFailed(failure_summary(plans, failed))


def check_complete(plans: Sequence[Plan]) -> None:
    """Raise SeedsFailed, as `run`, for seeds that other processes left incomplete."""
    plans = merged(plans)
    failed = {
        plan.directory: {seed: _why_incomplete(plan, seed) for seed in left}
        for plan in plans
        if (left := records.pending(plan))
    }
    if failed:
        raise SeedsFailed(failure_summary(plans, failed))


def failure_summary(plans: Sequence[Plan], failed: Failures) -> str:
    """Which seeds failed and why, and the commands that run them again."""
    number = sum(map(len, failed.values()))
    lines = [f"{number} seed{'s' * (number > 1)} failed, all others are complete:"]
    lost = [plan for plan in plans if plan.directory in failed]
    for plan in lost:
        reasons = dict(sorted(failed[plan.directory].items()))
        for why, seeds in records.by_reason(reasons):
            lines.append(f"  {plan.env} {plan.name}, {records.named(seeds)}: {why}")
    lines.append(f"to run just {'these' if number > 1 else 'this'} again:")
    lines += [f"  {line}" for plan in lost for line in plan.command.splitlines()]
    return "\n".join(lines)


def _why_incomplete(plan: Plan, seed: int) -> str:
    """Why a seed isn't complete, by its files."""
    if why := records.damaged(plan.directory, [seed]).get(seed):
        return why
    noted = records.read_facts(plan.directory, seed).get("status", "never begun")
    if noted == RUNNING:
        return "begun, but its process died or was stopped"
    return noted.removeprefix("failed: ")


def _prepare(plan: Plan, quiet: bool) -> None:
    """Check a plan's folder, remove leftovers of dead processes, say what is done."""
    records.check_directory(plan)
    locks.tidy(plan.directory)
    checkpoints.remove_done(plan)
    name = f"{plan.env} {plan.name}"
    if note := costs.memory_note(plan):
        say(f"{name}: {note}")
    for line in status.damage(plan.directory, plan.seeds):
        say(f"bcrl: {line}")
    done = len(plan.seeds) - len(records.pending(plan))
    if done and not quiet:
        say(f"{name}: {done} of {len(plan.seeds)} seeds complete")


def _search_references(plans: Sequence[Plan]) -> None:
    """Search Q* of every task whose metrics need it: BcrlError if that fails."""
    tasks: dict[Any, None] = {}
    for plan in plans:
        measured = plan.metrics if plan.family == "FQI" else ()
        if any(metric.startswith("q_error") for metric in measured):
            tasks |= dict.fromkeys((plan.target, *(s.env for s in plan.stages)))
    for task in tasks:
        oracle.reference(task)


def _train(
    jobs: Sequence[Job], options: Mapping[str, Any], failed: Failures, stop: Stop
) -> list[locks.Lock]:
    """Do the jobs; add their failures to `failed`, return the locks of busy seeds."""
    workers = min(options["workers"], len(jobs))
    threads = options["threads"] or max(1, cores() // workers)
    origin = run_origin()  # of the code that starts: its files may change meanwhile
    jobs = [replace(each, threads=threads, origin=origin) for each in jobs]
    shown = Progress(jobs, workers, options["progress"])
    busy = []
    try:
        for number, outcome in _outcomes(jobs, workers, shown.tick, stop):
            plan, seeds = jobs[number].plan, jobs[number].seeds
            if isinstance(outcome, Died):
                lost = set(records.pending(plan)).intersection(seeds)
                died = dict.fromkeys(
                    () if stop.requested else sorted(lost), str(outcome)
                )
                outcome = job.Outcome(died)
            if outcome.failed:
                failed.setdefault(plan.directory, {}).update(outcome.failed)
            busy += [locks.seed_lock(plan.directory, seed) for seed in outcome.busy]
    finally:
        shown.close()
    return busy


def _outcomes(
    jobs: Sequence[Job], workers: int, tick: Callable[[int, Tick], None], stop: Stop
) -> Iterator[tuple[int, job.Outcome | Died]]:
    """The jobs' numbers and outcomes, in this process or by several."""
    if workers > 1:
        yield from do_jobs(job.train, jobs, workers, tick, stop)
        return
    for number, each in enumerate(jobs):
        if stop.requested:
            return
        yield number, job.train(each, partial(tick, number), stop)


def _wait(busy: Sequence[locks.Lock], quiet: bool, stop: Stop) -> None:
    """Wait until one of the seeds that other processes compute is free or complete."""
    if not quiet:
        lock = busy[0]
        held = f"{lock.name} in {lock.folder} is computed by {lock.holder()}"
        more = f", and {len(busy) - 1} more are" * (len(busy) > 1)
        say(f"waiting: {held}{more}")
    pause = 0.1
    while not stop.requested:
        for lock in busy:
            if lock.acquire():
                lock.release()
                return
        time.sleep(pause)
        pause = min(2.0, 1.5 * pause)
