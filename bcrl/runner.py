"""The one runner: the seeds of plans, trained in lockstep groups, become records."""

from __future__ import annotations

import multiprocessing
import os
import queue
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from pathlib import Path

import numpy as np

from bcrl import costs, oracle, records
from bcrl.compose import Plan
from bcrl.envs import Env
from bcrl.evaluation import StepProbe
from bcrl.probes import Probe
from bcrl.progress import Job, Progress, Tick
from bcrl.stage import Team, learn

Seeds = tuple[int, ...]


def run(*plans: Plan) -> None:
    """Compute and record every seed of the plans that is not complete yet.

    All of them share one pool of processes: jobs of a few seeds, the longest first.
    """
    began, options = time.perf_counter(), plans[0].config
    work = ordered(plans)
    if work:
        _search_references([plan for plan, _ in work])
        workers = min(options["workers"], len(work))
        jobs = [_job(plan, seeds) for plan, seeds in work]
        progress = Progress(jobs, workers, options["progress"])
        try:
            _train(work, workers, progress.tick)
        finally:
            progress.close()
    if len(plans) > 1 and options["progress"] != "none":
        spent = time.perf_counter() - began
        print(records.closing_table(plans, spent), file=sys.stderr)


def ordered(plans: Sequence[Plan]) -> list[tuple[Plan, Seeds]]:
    """The jobs that remain to be done, the one expected to be longest first."""
    return sorted(
        _pending(plans), key=lambda each: -len(each[1]) * costs.expected(each[0])
    )


def _pending(plans: Sequence[Plan]) -> Iterator[tuple[Plan, Seeds]]:
    """Groups of seeds that are to be trained, each seed of a directory once."""
    taken: set[tuple[Path, int]] = set()
    for plan in plans:
        seeds = [
            seed
            for seed in records.open_directory(plan)
            if (plan.directory, seed) not in taken
        ]
        taken |= {(plan.directory, seed) for seed in seeds}
        skipped = len(plan.seeds) - len(seeds)
        if skipped and plan.config["progress"] != "none":
            said = f"{skipped} of {len(plan.seeds)} seeds complete"
            print(f"{plan.env} {plan.name}: {said}", file=sys.stderr)
        if seeds:
            yield from ((plan, group) for group in _groups(plan, seeds))


def _groups(plan: Plan, seeds: list[int]) -> list[Seeds]:
    """Seeds that train together: at most as allowed, spread evenly over the workers."""
    workers = min(plan.config["workers"], len(seeds))
    rounds = -(-len(seeds) // (plan.lockstep * workers))
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


def _job(plan: Plan, seeds: Seeds) -> Job:
    return Job(
        f"{plan.env} {plan.name}",
        f"{plan.env} {plan.family}",
        seeds,
        plan.length,
        _probe(plan, ()).index,
        costs.expected(plan) * len(seeds),
    )


def _train(
    work: Sequence[tuple[Plan, Seeds]], workers: int, tick: Callable[[Tick], None]
) -> None:
    threads = work[0][0].config["threads"] or max(1, _cores() // workers)
    origin = records.provenance()  # of the code that starts, not of what it becomes
    if workers == 1:
        for number, (plan, seeds) in enumerate(work):
            train_group(plan, seeds, threads, origin, number, tick)
        return
    context = multiprocessing.get_context("spawn")
    with context.Manager() as manager:
        ticks = manager.Queue()
        pool = ProcessPoolExecutor(workers, context, initializer=_leave_interrupts)
        try:
            jobs = [
                pool.submit(train_group, *each, threads, origin, number, ticks.put)
                for number, each in enumerate(work)
            ]
            waiting = set(jobs)
            while waiting:
                _drain(ticks, tick)
                done, waiting = wait(waiting, timeout=0)
                for job in done:
                    job.result()
            _drain(ticks, tick)
        except BaseException:  # a failure or Ctrl-C ends all workers at once
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in multiprocessing.active_children():
                worker.terminate()
            raise
        pool.shutdown()


def _leave_interrupts() -> None:
    """Ctrl-C reaches every process of a terminal; the parent alone deals with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _drain(ticks: queue.Queue, tick: Callable[[Tick], None]) -> None:
    """Hand on the workers' ticks, waiting for a moment if there is none."""
    try:
        tick(ticks.get(timeout=0.2))
        for _ in range(ticks.qsize()):
            tick(ticks.get_nowait())
    except queue.Empty:
        return


def _cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def train_group(
    plan: Plan,
    seeds: Seeds,
    threads: int,
    origin: dict,
    job: int,
    tick: Callable[[Tick], None],
) -> None:
    """Train a group of seeds in lockstep and write each seed's files.

    origin: which code and machine, as `records.provenance` says; job: the number that
    ticks are to bear.
    """
    wall, cpu = time.perf_counter(), time.process_time()
    probe = _probe(plan, seeds)
    team = Team(seeds, probe.states, threads, plan.device)
    rows: list[list[dict]] = [[] for _ in seeds]
    failed: dict[int, str] = {}
    for now in learn(plan.stages, team):
        task = now.stage.task
        where = {"stage": now.stage.number, "task": task, probe.index: now.count}
        for s, metrics in enumerate(probe.measure(now)):
            if s not in failed:  # its last row is the one that shows the failure
                rows[s].append(where | metrics)
        for s, why in now.failed.items():
            failed.setdefault(s, f"{why} at {probe.index} {now.count}")
        tick(Tick(job, task, now.count, time.perf_counter() - wall))
    facts = probe.facts() | {
        "wall_seconds": time.perf_counter() - wall,
        "cpu_seconds": (time.process_time() - cpu) / len(seeds),  # this seed's share
        "lockstep": list(seeds),
        "device": plan.device,
        "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    for s, seed in enumerate(seeds):
        status = f"failed: {failed[s]}" if s in failed else "complete"
        if s in failed:
            print(f"{plan.env} {plan.name}: seed {seed} {status}", file=sys.stderr)
        records.write_seed(plan, seed, status, rows[s], probe.arrays(s), facts | origin)


def _probe(plan: Plan, seeds: Seeds) -> Probe | StepProbe:
    if plan.family == "DQN":
        return StepProbe(seeds, plan.tasks)
    return Probe(seeds, plan.tasks, plan.metrics)
