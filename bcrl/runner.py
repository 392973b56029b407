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
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from bcrl import costs, oracle, records
from bcrl.compose import Plan
from bcrl.envs import Env
from bcrl.errors import BcrlError
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
    plans = tuple(merged(plans))
    work = ordered(plans)
    if work:
        _search_references([plan for plan, _ in work])
        workers = min(options["workers"], len(work))
        jobs = [_job(plan, seeds) for plan, seeds in work]
        progress = Progress(jobs, workers, options["progress"])
        try:
            _train(work, workers, options["threads"], progress.tick)
        finally:
            progress.close()
    if len(plans) > 1 and options["progress"] != "none":
        spent = time.perf_counter() - began
        print(records.closing_table(plans, spent), file=sys.stderr)


def merged(plans: Sequence[Plan]) -> Iterator[Plan]:
    """The plans, those of one directory as one with the seeds of all."""
    together: dict[Path, Plan] = {}
    for plan in plans:
        before = together.get(plan.directory, plan)
        seeds = tuple(dict.fromkeys(before.seeds + plan.seeds))
        together[plan.directory] = replace(before, seeds=seeds)
    yield from together.values()


def ordered(plans: Sequence[Plan]) -> list[tuple[Plan, Seeds]]:
    """The jobs that remain to be done, the one expected to be longest first."""
    pending = [(plan, seeds) for plan in plans if (seeds := _pending(plan))]
    workers = plans[0].config["workers"]
    # With variants enough to go round, seeds that train together cost less each.
    spread = 1 if len(pending) >= 2 * workers else workers
    work = [
        (plan, group)
        for plan, seeds in pending
        for group in _groups(seeds, plan.lockstep, spread)
    ]
    return sorted(work, key=lambda job: -len(job[1]) * costs.expected(job[0]))


def _pending(plan: Plan) -> list[int]:
    """The plan's seeds that are to be trained."""
    seeds = records.pending(plan)
    done = len(plan.seeds) - len(seeds)
    if done and plan.config["progress"] != "none":
        said = f"{done} of {len(plan.seeds)} seeds complete"
        print(f"{plan.env} {plan.name}: {said}", file=sys.stderr)
    return seeds


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
    work: Sequence[tuple[Plan, Seeds]],
    workers: int,
    threads: int | None,
    tick: Callable[[Tick], None],
) -> None:
    threads = threads or max(1, _cores() // workers)
    origin = records.provenance()  # of the code that starts, not of what it becomes
    if workers == 1:
        for number, (plan, seeds) in enumerate(work):
            train = partial(train_group, plan, seeds, threads, origin, number, tick)
            _blamed(train, plan, seeds)
        return
    context = multiprocessing.get_context("spawn")
    with context.Manager() as manager:
        ticks = manager.Queue()
        pool = ProcessPoolExecutor(workers, context, initializer=_leave_interrupts)
        try:
            jobs = {
                pool.submit(
                    train_group, *each, threads, origin, number, ticks.put
                ): each
                for number, each in enumerate(work)
            }
            waiting = set(jobs)
            while waiting:
                _drain(ticks, tick)
                done, waiting = wait(waiting, timeout=0)
                for job in done:
                    _blamed(job.result, *jobs[job])
            _drain(ticks, tick)
        except BaseException:  # a failure or Ctrl-C ends all workers at once
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in multiprocessing.active_children():
                worker.terminate()
            raise
        pool.shutdown()


def _blamed(call: Callable[[], None], plan: Plan, seeds: Seeds) -> None:
    """`call`, an unforeseen error of it preceded by a line that names the job."""
    try:
        call()
    except BcrlError:
        raise
    except Exception:
        print(f"{plan.env} {plan.name}, seeds {seeds}: failed", file=sys.stderr)
        raise


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
    records.begin(plan)
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
