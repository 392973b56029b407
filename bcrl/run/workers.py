"""Processes that do jobs one after the other; if one dies, its job has failed."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import connection, resource_tracker
from typing import Any

from bcrl.common.signals import SIGNALS, Stop
from bcrl.common.terminal import count

#: A job's arguments, a function to report with, and whether to stop → its result.
Do = Callable[[Any, Callable[[Any], None], Stop], Any]


@dataclass(frozen=True)
class Died:
    """What became of a job whose process ended by itself."""

    exitcode: int

    def __str__(self) -> str:
        if self.exitcode == -signal.SIGKILL:
            return "killed (out of memory? try fewer workers or seeds.lockstep)"
        return f"its process ended with exit code {self.exitcode}"


class _Worker:
    """A process, and the job it is at."""

    def __init__(self, do: Do) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(do, theirs), daemon=True)
        resource_tracker.ensure_running()  # it would unblock what is blocked below
        # Inherited: a worker hears no signal before it can deal with it.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        try:
            self.process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()  # so that its end shows here
        self.job: int | None = None

    def end(self) -> None:
        self.pipe.close()  # no further job: it leaves
        self.process.join(10.0)
        if self.process.is_alive():
            self.process.kill()


def each(
    do: Do,
    jobs: Sequence[Any],
    workers: int,
    report: Callable[[Any], None],
    stop: Stop,
) -> Iterator[tuple[int, Any]]:
    """The jobs' numbers and results as they come, done in order by `workers` processes.

    A job whose process dies results in `Died`. Asked to stop, jobs under way are told
    so, and no other is begun.
    """
    team = [_Worker(do) for _ in range(min(workers, len(jobs)))]
    waiting, told = list(enumerate(jobs)), False
    try:
        for worker in team:
            _hand(worker, waiting)
        while any(worker.job is not None for worker in team):
            if stop.asked and not told:
                waiting, told = [], True
                for worker in team:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(worker.process.pid, signal.SIGTERM)
            busy = {w.pipe: n for n, w in enumerate(team) if w.job is not None}
            for pipe in connection.wait(list(busy), timeout=0.2):
                place = busy[pipe]
                worker = team[place]
                try:
                    kind, message = pipe.recv()
                except (EOFError, OSError):
                    worker.process.join()
                    job, worker.job = worker.job, None
                    if worker.process.exitcode:
                        yield job, Died(worker.process.exitcode)
                    elif not stop.asked:  # it was told to leave before it began
                        waiting.insert(0, (job, jobs[job]))
                    if waiting:
                        team[place] = worker = _Worker(do)
                else:
                    if kind == "report":
                        report(message)
                        continue
                    job, worker.job = worker.job, None
                    yield job, message
                _hand(worker, waiting)
    finally:
        for worker in team:
            worker.end()


def cores() -> int:
    """Cores that this process may use; not every Slurm binds a job to its own."""
    there = os.cpu_count() or 1
    if hasattr(os, "sched_getaffinity"):
        there = len(os.sched_getaffinity(0))
    return min(there, count("SLURM_CPUS_PER_TASK") or there)


def _hand(worker: _Worker, waiting: list[tuple[int, Any]]) -> None:
    """The next job goes to this worker, if there is one."""
    if waiting:
        number, job = waiting.pop(0)
        with contextlib.suppress(OSError):  # if it died idle, that will be seen
            worker.pipe.send(job)
        worker.job = number


def _serve(do: Do, pipe: connection.Connection) -> None:
    """A worker's life: jobs, until the pipe closes or a signal comes."""
    stop = Stop()

    def report(message: Any) -> None:
        try:
            pipe.send(("report", message))
        except OSError:  # nobody listens any more
            stop.ask()

    with stop.on_signals(second_ends_all=False):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        while not stop.asked:
            try:
                job = pipe.recv()
            except (EOFError, OSError):
                return
            result = do(job, report, stop)
            with contextlib.suppress(OSError):
                pipe.send(("result", result))
