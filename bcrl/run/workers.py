"""Processes that do jobs one after the other; if one dies, only its job fails."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import connection, resource_tracker
from typing import Any

from bcrl.common.signals import SIGNALS, Stop
from bcrl.common.terminal import count

#: A job, a function to report with, and the stop that ends it early → its result.
Do = Callable[[Any, Callable[[Any], None], Any], Any]


@dataclass(frozen=True)
class Died:
    """The result of a job whose process ended by itself."""

    exitcode: int

    def __str__(self) -> str:
        if self.exitcode == -signal.SIGKILL:
            return "killed (out of memory? try fewer workers or seeds.lockstep)"
        return f"its process ended with exit code {self.exitcode}"


class _Worker:
    """A process, and the number of its job; it ends with the pipe or a None in it."""

    def __init__(self, do: Do) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(do, theirs), daemon=True)
        resource_tracker.ensure_running()  # it would unblock what is blocked below
        # A worker inherits the mask: no signal comes before it can ignore it.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        try:
            self.process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()  # so that its end shows here
        self.job = -1  # no job

    def send(self, job: Any) -> None:
        """Give a job, or None; if the process is dead, `recv` will show it."""
        with suppress(OSError):
            self.pipe.send(job)

    def end(self) -> None:
        """Let the process end, without a further job."""
        self.pipe.close()
        self.process.join(10.0)
        if self.process.is_alive():
            self.process.kill()


def do_jobs(
    do: Do,
    jobs: Sequence[Any],
    workers: int,
    report: Callable[[int, Any], None],
    stop: Stop,
) -> Iterator[tuple[int, Any]]:
    """The jobs' numbers and results as they come, done in order by `workers` processes.

    `report` takes a job's number and its reports. A job whose process dies results in
    `Died`. After a request to stop, running jobs stop, too, and no other begins.
    """
    pool = [_Worker(do) for _ in range(min(workers, len(jobs)))]
    waiting, stopped = list(range(len(jobs))), False
    try:
        while True:
            for place, worker in enumerate(pool):
                if waiting and worker.job < 0:
                    if not worker.process.is_alive():
                        pool[place] = worker = _Worker(do)
                    worker.job = waiting.pop(0)
                    worker.send(jobs[worker.job])
            busy: dict[Any, _Worker] = {w.pipe: w for w in pool if w.job >= 0}
            if not busy:
                return
            if stop.requested and not stopped:
                waiting, stopped = [], True
                for worker in busy.values():
                    worker.send(None)
            for pipe in connection.wait(list(busy), timeout=0.2):
                worker = busy[pipe]
                try:
                    kind, message = worker.pipe.recv()
                except (EOFError, OSError):
                    worker.process.join()
                    kind, message = "result", Died(worker.process.exitcode or 0)
                if kind == "report":
                    report(worker.job, message)
                else:
                    job, worker.job = worker.job, -1
                    yield job, message
    finally:
        for worker in pool:
            worker.end()


def cores() -> int:
    """Cores that this process may use; not every Slurm binds a job to its own."""
    there = os.cpu_count() or 1
    if hasattr(os, "sched_getaffinity"):
        there = len(os.sched_getaffinity(0))
    return min(there, count("SLURM_CPUS_PER_TASK") or there)


class _StopByPipe:
    """A worker's stop: a message from its parent, or the parent's end."""

    def __init__(self, pipe: connection.Connection) -> None:
        self._pipe, self._requested, self._next = pipe, False, 0.0

    @property
    def requested(self) -> bool:
        """Whether to stop; the pipe is polled ten times per second at most."""
        if (now := time.monotonic()) > self._next:
            self._requested, self._next = self._pipe.poll(), now + 0.1
        return self._requested


def _serve(do: Do, pipe: connection.Connection) -> None:
    """A worker's life: jobs, until a None comes or the pipe closes."""

    def report(message: Any) -> None:
        with suppress(OSError):  # the parent is gone, which `_StopByPipe` shows
            pipe.send(("report", message))

    for number in SIGNALS:  # for the parent; processes of a job's own get them again
        signal.signal(number, lambda *_: None)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    with suppress(EOFError, OSError):
        while (job := pipe.recv()) is not None:
            pipe.send(("result", do(job, report, _StopByPipe(pipe))))
