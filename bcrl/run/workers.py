"""Processes that do jobs one after the other; if one dies, only its job fails."""

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from multiprocessing import connection, resource_tracker
from types import ModuleType
from typing import Any

from bcrl.common.signals import SIGNALS, Stop
from bcrl.common.terminal import count

_KILLED = "killed (out of memory? try fewer workers or seeds.lockstep)"
#: A job, a function to report with, and the stop that ends it early → its result.
Do = Callable[[Any, Callable[[Any], None], Any], Any]


def do_jobs(
    do: Do, jobs: Sequence, workers: int, report: Callable[[int, Any], None], stop: Stop
) -> Iterator[tuple[int, Any]]:
    """The jobs' numbers and results as they come, done in order by `workers` processes.

    One worker is this process. `report` takes a job's number and its reports. If a
    process dies, its job's result is a text that says so. After a request to stop,
    running jobs stop, too, and no other begins.
    """
    if workers == 1:
        for number, job in enumerate(jobs):
            if not stop.requested:
                yield number, do(job, partial(report, number), stop)
        return
    pool = dict(_started(do) for _ in range(min(workers, len(jobs))))
    waiting, stopped = list(range(len(jobs))), False
    doing: dict[Any, int] = {}  # the number of a job, by its process's pipe
    try:
        while True:
            for pipe in [p for p in pool if p not in doing][: len(waiting)]:
                doing[pipe] = waiting.pop(0)
                _send(pipe, jobs[doing[pipe]])
            if not doing:
                return
            if stop.requested and not stopped:
                waiting, stopped = [], True
                for pipe in doing:
                    _send(pipe, None)
            for pipe in connection.wait(list(doing), timeout=0.2):
                try:
                    kind, message = pipe.recv()
                except (EOFError, OSError):
                    process = pool.pop(pipe)
                    process.join()
                    why = f"its process ended with exit code {process.exitcode}"
                    killed = process.exitcode == -signal.SIGKILL
                    kind, message = "result", _KILLED if killed else why
                    if waiting:
                        pool.update([_started(do)])
                if kind == "report":
                    report(doing[pipe], message)
                else:
                    yield doing.pop(pipe), message
    finally:
        for pipe, process in pool.items():
            pipe.close()  # then it ends
            process.join(10.0)
            if process.is_alive():
                process.kill()


def _started(do: Do) -> tuple[Any, Any]:
    """A pipe to a new process, and the process; closing the pipe ends it."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(do, theirs), daemon=True)
    resource_tracker.ensure_running()  # it would unblock what is blocked below
    # A worker inherits the mask: no signal comes before it can ignore it.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
    try:  # a worker imports no script: it would run as a whole once more
        process.start()
    finally:
        sys.modules["__main__"] = main
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    theirs.close()  # so that the process's end shows in ours
    return ours, process


def _send(pipe: Any, message: Any) -> None:
    with suppress(OSError):  # the other end is gone, which `recv` and `poll` show
        pipe.send(message)


def cores() -> int:
    """Cores that this process may use; not every Slurm binds a job to its own."""
    affinity = getattr(os, "sched_getaffinity", None)
    there = len(affinity(0)) if affinity else os.cpu_count() or 1
    return min(there, count("SLURM_CPUS_PER_TASK") or there)


class _StopByPipe:
    """A worker's stop: a message from its parent, or the parent's end."""

    def __init__(self, pipe: Any) -> None:
        self._pipe, self._requested, self._next = pipe, False, 0.0

    @property
    def requested(self) -> bool:
        """Whether to stop; the pipe is polled ten times per second at most."""
        if (now := time.monotonic()) > self._next:
            self._requested, self._next = self._pipe.poll(), now + 0.1
        return self._requested


def _serve(do: Do, pipe: Any) -> None:
    """A worker's life: jobs, until a None comes or the pipe closes."""
    for number in SIGNALS:  # for the parent; processes of a job's own get them again
        signal.signal(number, lambda *_: None)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    with suppress(EOFError, OSError):
        while (job := pipe.recv()) is not None:
            result = do(job, lambda x: _send(pipe, ("report", x)), _StopByPipe(pipe))
            pipe.send(("result", result))
