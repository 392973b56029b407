"""The one runner: a plan's seeds, trained in lockstep groups, become records."""

from __future__ import annotations

import multiprocessing
import os
import queue
import resource
import signal
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, wait

import numpy as np

from bcrl import oracle, records
from bcrl.compose import Plan
from bcrl.evaluation import StepProbe
from bcrl.probes import Probe
from bcrl.progress import Progress, Tick
from bcrl.stage import Team, learn

Seeds = tuple[int, ...]


def run(plan: Plan) -> None:
    """Compute every seed of the plan that is not complete yet, and record it."""
    pending = records.open_directory(plan)
    name = f"{plan.env} {plan.name}"
    skipped = len(plan.seeds) - len(pending)
    if skipped and plan.config["progress"] != "none":
        print(f"{name}: {skipped} of {len(plan.seeds)} seeds complete", file=sys.stderr)
    if not pending:
        return
    measured = plan.metrics if plan.family == "FQI" else ()
    if any(metric.startswith("q_error") for metric in measured):
        for task in dict.fromkeys((plan.target, *(s.env for s in plan.stages))):
            oracle.reference(task)  # searched for once, here, and kept on disk
    unit = _probe(plan, ()).index
    progress = Progress(name, pending, plan.length, unit, plan.config["progress"])
    try:
        _train(plan, _groups(plan, pending), progress.tick)
    finally:
        progress.close()


def _groups(plan: Plan, seeds: list[int]) -> list[Seeds]:
    """Seeds that train together: at most as allowed, spread evenly over the workers."""
    workers = min(plan.config["workers"], len(seeds))
    rounds = -(-len(seeds) // (plan.lockstep * workers))
    groups = min(rounds * workers, len(seeds))
    return [tuple(part.tolist()) for part in np.array_split(seeds, groups)]


def _train(plan: Plan, groups: list[Seeds], tick: Callable[[Tick], None]) -> None:
    workers = min(plan.config["workers"], len(groups))
    threads = plan.config["threads"] or max(1, _cores() // workers)
    origin = records.provenance()  # of the code that starts, not of what it becomes
    if workers == 1:
        for group in groups:
            train_group(plan, group, threads, origin, tick)
        return
    context = multiprocessing.get_context("spawn")
    with context.Manager() as manager:
        ticks = manager.Queue()
        pool = ProcessPoolExecutor(workers, context, initializer=_leave_interrupts)
        try:
            jobs = [
                pool.submit(train_group, plan, group, threads, origin, ticks.put)
                for group in groups
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
    tick: Callable[[Tick], None],
) -> None:
    """Train a group of seeds in lockstep and write each seed's files.

    origin: which code and machine, as `records.provenance` says.
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
        tick(Tick(seeds, task, now.count, now.last_of_stage))
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
