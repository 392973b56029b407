"""The one runner: the seeds of plans become jobs, done by processes, and records."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bcrl.common import compiling
from bcrl.common.signals import Interrupted, Stop
from bcrl.common.terminal import say
from bcrl.config.plan import Plan
from bcrl.envs import Env
from bcrl.errors import BcrlError
from bcrl.evaluation import oracle
from bcrl.run import checkpoints, costs, locks, progress, records
from bcrl.run import job as training
from bcrl.run.workers import Died, cores, each

Seeds = tuple[int, ...]


@dataclass
class Failed:
    """A plan's seeds that failed, and why."""

    plan: Plan
    why: dict[int, str] = field(default_factory=dict)


Failures = dict[Path, Failed]  # by the plan's directory


class SeedsFailed(BcrlError):
    """Some seeds failed, all others are complete: which, why, and what reruns them."""

    exit_code = 1


def run(*plans: Plan) -> None:
    """Compute and record every seed of the plans that is not complete yet.

    All of them share one pool of processes: jobs of a few seeds, the longest first. A
    seed that another process computes is waited for. Raises SeedsFailed at the end if
    seeds failed, Interrupted if a signal came, both with everything else kept.
    """
    began, options = time.perf_counter(), plans[0].config
    plans, stop = tuple(merged(plans)), Stop()
    failed: Failures = {}
    if options["progress"] != "none" and (why := compiling.why_uncached()):
        say(why)
    with stop.on_signals(second_ends_all=True):
        for plan in plans:
            _look_round(plan)
        while (work := ordered(plans, failed)) and not stop.asked:
            _search_references([plan for plan, _ in work])
            if busy := _train(work, options, failed, stop):
                _wait(busy, options["progress"], stop)
    if work:
        raise Interrupted
    if options["progress"] != "none":
        for note in filter(None, map(records.diverged, plans)):
            say(note)
    if len(plans) > 1 and options["progress"] != "none":
        spent = time.perf_counter() - began
        say(records.closing_table(plans, spent))
    if failed:
        raise SeedsFailed(told(failed))


def merged(plans: Sequence[Plan]) -> Iterator[Plan]:
    """The plans, those of one directory as one with the seeds of all."""
    together: dict[Path, Plan] = {}
    for plan in plans:
        before = together.get(plan.directory, plan)
        seeds = tuple(dict.fromkeys(before.seeds + plan.seeds))
        asked = tuple(dict.fromkeys(before.asked + plan.asked))
        commands = dict.fromkeys([*before.command.splitlines(), plan.command])
        command = "\n".join(commands)
        whole = replace(before, asked=asked, seeds=seeds, command=command)
        together[plan.directory] = whole
    yield from together.values()


def ordered(plans: Sequence[Plan], failed: Failures) -> list[tuple[Plan, Seeds]]:
    """The jobs that remain to be done, the one expected to be longest first.

    A team with a checkpoint goes on as it was; no seed is tried again that has failed.
    """
    pending, work = [], []
    for plan in plans:
        over = failed.get(plan.directory, Failed(plan)).why
        left = [seed for seed in records.pending(plan) if seed not in over]
        try:
            teams = checkpoints.teams(plan) if left else []
        except BcrlError as error:
            failed[plan.directory] = Failed(
                plan, over | dict.fromkeys(left, str(error))
            )
            continue
        for team in teams:
            if set(team) & set(left):
                work.append((plan, team))
                left = [seed for seed in left if seed not in team]
        if left:
            pending.append((plan, left))
    workers = plans[0].config["workers"]
    # With variants enough to go round, seeds that train together cost less each.
    spread = 1 if len(pending) >= 2 * workers else workers
    work += [
        (plan, group)
        for plan, seeds in pending
        for group in _groups(seeds, plan.lockstep, spread)
    ]
    return sorted(work, key=lambda job: -len(job[1]) * costs.expected(job[0]))


def check_complete(plans: Sequence[Plan]) -> None:
    """Raise SeedsFailed, as `run`, for seeds that other processes have left undone."""
    failed: Failures = {}
    for plan in merged(plans):
        why = {seed: _undone(plan, seed) for seed in records.pending(plan)}
        if why:
            failed[plan.directory] = Failed(plan, why)
    if failed:
        raise SeedsFailed(told(failed))


def _undone(plan: Plan, seed: int) -> str:
    """Why a seed isn't complete, as far as its files tell."""
    why = records.damaged(plan.directory, [seed]).get(seed)
    status = why or records.status(plan, seed) or "never begun"
    if status == "running":
        return "begun, but its process is gone or was told to leave"
    return status.removeprefix("failed: ")


def _look_round(plan: Plan) -> None:
    """Check a plan's directory, tidy what dead processes left, say what is done."""
    records.check_directory(plan)
    locks.tidy(plan.directory)
    checkpoints.remove_done(plan)
    if (needed := costs.memory(plan)) > (there := costs.available()):
        few = "seeds.lockstep=1, fewer episodes, a smaller replay or observations"
        sizes = f"up to {needed / 2**30:.1f} GiB of memory, of {there / 2**30:.1f} GiB"
        say(f"{plan.env} {plan.name}: the data of a team take {sizes}; {few} take less")
    for line in damage(plan.directory, plan.seeds):
        say(f"bcrl: {line}")
    done = len(plan.seeds) - len(records.pending(plan))
    if done and plan.config["progress"] != "none":
        said = f"{done} of {len(plan.seeds)} seeds complete"
        say(f"{plan.env} {plan.name}: {said}")


def damage(directory: Path, seeds: Sequence[int]) -> Iterator[str]:
    """A line for each way in which files of finished seeds are damaged."""
    found = records.damaged(directory, seeds)
    for why in dict.fromkeys(found.values()):
        lost = [seed for seed, reason in found.items() if reason == why]
        name = f"{' '.join(directory.parts[-3:])}, {progress.named(lost)}"
        yield f"{name}: {why}; a rerun makes {'them' if lost[1:] else 'it'} again"


def _groups(seeds: list[int], lockstep: int, workers: int) -> list[Seeds]:
    """Seeds that train together: at most `lockstep`, spread evenly over the workers."""
    workers = min(workers, len(seeds))
    rounds = -(-len(seeds) // (lockstep * workers))
    groups = min(rounds * workers, len(seeds))
    return [tuple(part.tolist()) for part in np.array_split(seeds, groups)]


def _search_references(plans: Sequence[Plan]) -> None:
    """Q* of every task that is measured by it: searched for once and kept on disk."""
    tasks: dict[Env, None] = {}
    for plan in plans:
        measured = plan.metrics if plan.family == "FQI" else ()
        if any(metric.startswith("q_error") for metric in measured):
            tasks |= dict.fromkeys((plan.target, *(s.env for s in plan.stages)))
    for task in tasks:
        oracle.reference(task)


def _expected(plan: Plan, seeds: Seeds) -> progress.Job:
    """What the progress bar wants to know of a job."""
    return progress.Job(
        f"{plan.env} {plan.name}",
        f"{plan.env} {plan.family}",
        seeds,
        plan.length,
        training.probe_of(plan, ()).index,
        costs.expected(plan) * len(seeds),
    )


def _train(
    work: Sequence[tuple[Plan, Seeds]],
    options: Mapping[str, Any],
    failed: Failures,
    stop: Stop,
) -> list[tuple[Plan, Seeds]]:
    """Do the jobs; what failed is added to `failed`, seeds that are busy returned."""
    workers = min(options["workers"], len(work))
    threads = options["threads"] or max(1, cores() // workers)
    origin = records.provenance()  # of the code that starts, not of what it becomes
    jobs = [
        training.Job(number, plan, seeds, threads, origin)
        for number, (plan, seeds) in enumerate(work)
    ]
    expected = [_expected(plan, seeds) for plan, seeds in work]
    shown = progress.Progress(expected, workers, options["progress"])
    busy = []
    try:
        for number, outcome in _outcomes(jobs, workers, shown.tick, stop):
            plan, seeds = work[number]
            if isinstance(outcome, Died):
                done = records.is_complete
                lost = [s for s in seeds if not done(plan.directory, s)]
                died = dict.fromkeys([] if stop.asked else lost, str(outcome))
                outcome = training.Outcome(died)
            if outcome.failed:
                failed.setdefault(plan.directory, Failed(plan)).why |= outcome.failed
            if outcome.busy:
                busy.append((plan, outcome.busy))
    finally:
        shown.close()
    return busy


def _outcomes(
    jobs: Sequence[training.Job],
    workers: int,
    tick: Callable[[progress.Tick], None],
    stop: Stop,
) -> Iterator[tuple[int, training.Outcome | Died]]:
    """The jobs' numbers and outcomes, in this process or by several."""
    if workers > 1:
        yield from each(training.train, jobs, workers, tick, stop)
        return
    for job in jobs:
        if stop.asked:
            return
        yield job.number, training.train(job, tick, stop)


def _wait(busy: Sequence[tuple[Plan, Seeds]], mode: str, stop: Stop) -> None:
    """Until one of the seeds that other processes compute is free, or complete."""
    seeds = [
        locks.seed_lock(plan.directory, seed) for plan, group in busy for seed in group
    ]
    if mode != "none":
        lock = seeds[0]
        held = f"{lock.name} in {lock.folder} is computed by {lock.holder()}"
        more = f", and {len(seeds) - 1} more are" * (len(seeds) > 1)
        say(f"waiting: {held}{more}")
    pause = 0.1
    while not stop.asked:
        for lock in seeds:
            if lock.acquire():
                lock.release()
                return
        time.sleep(pause)
        pause = min(2.0, 1.5 * pause)


def told(failed: Failures) -> str:
    """What failed, and the commands that run it again."""
    count = sum(len(lost.why) for lost in failed.values())
    seeds = f"{count} seed{'s' * (count > 1)}"
    lines = [f"{seeds} failed, what else was asked for is complete:"]
    for lost in failed.values():
        reasons: dict[str, list[int]] = {}
        for seed, why in sorted(lost.why.items()):
            reasons.setdefault(why, []).append(seed)
        for why, seeds in reasons.items():
            name = f"{lost.plan.env} {lost.plan.name}"
            lines.append(f"  {name}, {progress.named(seeds)}: {why}")
    lines.append(f"to run just {'these' if count > 1 else 'this'} again:")
    for lost in failed.values():
        lines += [f"  {command}" for command in lost.plan.command.splitlines()]
    return "\n".join(lines)
