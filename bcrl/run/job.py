"""A job: a batch of seeds is trained in lockstep, checkpointed, and recorded."""

from __future__ import annotations

import json
import os
import resource
import socket
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bcrl.common.signals import Stop
from bcrl.common.terminal import say
from bcrl.config.plan import Plan
from bcrl.errors import BcrlError
from bcrl.evaluation.metrics import Probe
from bcrl.evaluation.step_metrics import StepProbe
from bcrl.learning.rollout import success_of
from bcrl.learning.stage import CurriculumRun, SeedBatch, Snapshot
from bcrl.results import loggers
from bcrl.results.layout import COMPLETE, RUNNING
from bcrl.run import checkpoints, records
from bcrl.run.locks import Lock, claimed
from bcrl.run.progress import Tick
from bcrl.run.schedule import Job


@dataclass(frozen=True)
class Outcome:
    """The result of a job; seeds that it does not name are complete."""

    failed: dict[int, str] = field(default_factory=dict)  # and why
    busy: tuple[int, ...] = ()  # in another process or another checkpoint's batch


def train(job: Job, tick: Callable[[Tick], None], stop: Stop) -> Outcome:
    """Train those of a job's seeds that are free and write each one's files.

    An error ends this job alone: its seeds have failed. After a request to `stop` it
    leaves a checkpoint, from which the next call resumes.
    """
    plan, seeds = job.plan, job.seeds
    try:
        records.make_run_directory(plan)
        with claimed(plan.directory, job.seeds) as held:
            seeds, busy, resumes = _free(job, held)
            if not seeds:
                return Outcome(busy=busy)
            strict = "raise" if plan.config["strict"] else "warn"
            try:
                with (
                    loggers.opened(plan.config, plan.directory, seeds) as log,
                    np.errstate(divide=strict, over=strict, invalid=strict),
                ):
                    training = _Training(job, seeds, held, log)
                    failed = training.train(resumes, tick, stop)
            except Exception as error:
                for seed in _incomplete(plan, seeds):
                    with suppress(BcrlError):  # the folder may be gone
                        status = f"failed: {_reason(error)}"
                        records.write_status(plan, seed, status, {})
                raise
            checkpoints.remove_done(plan)
            return Outcome(failed, busy)
    except Exception as error:
        if not isinstance(error, (BcrlError, MemoryError)):  # unforeseen: show where
            say(traceback.format_exc())
        who = f"{plan.env} {plan.name}, {records.named(seeds)}"
        say(f"{who}: failed: {_reason(error)}")
        return Outcome(dict.fromkeys(_incomplete(plan, seeds), _reason(error)))


def _free(
    job: Job, held: Mapping[int, Lock]
) -> tuple[tuple[int, ...], tuple[int, ...], bool]:
    """The seeds to train, those to try again later, and whether a checkpoint exists.

    The batch of a checkpoint resumes as a whole or not at all.
    """
    busy = tuple(seed for seed in job.seeds if seed not in held)
    begun = checkpoints.batches(job.plan)
    if job.seeds in begun:
        return ((), busy, False) if busy else (job.seeds, (), True)
    free = _incomplete(job.plan, held)
    if any(set(batch) & set(free) for batch in begun):
        return (), job.seeds, False  # the process that wrote it has just died
    return free, busy, False


def _incomplete(plan: Plan, seeds: Any) -> tuple[int, ...]:
    return tuple(s for s in seeds if not records.is_complete(plan.directory, s))


def _reason(error: Exception) -> str:
    if isinstance(error, MemoryError):
        what = "try fewer workers or seeds.lockstep, or a smaller scale"
        return " ".join(f"out of memory: {error} ({what})".split())
    known = isinstance(error, BcrlError)
    return str(error) if known else f"{type(error).__name__}: {error}"


@dataclass
class _Progress:
    """What a checkpoint stores besides the learners' state."""

    rows: list[list[dict[str, Any]]]  # of each seed's CSV
    failed: dict[int, str] = field(default_factory=dict)  # by place in the batch
    wall: float = 0.0  # seconds, with those before an interruption
    cpu: float = 0.0
    interruptions: int = 0


class _Training:
    """The training of seeds whose locks are `held`."""

    def __init__(
        self,
        job: Job,
        seeds: tuple[int, ...],
        held: Mapping[int, Lock],
        log: loggers.Log,
    ) -> None:
        self.job, self.plan, self.seeds = job, job.plan, seeds
        self.held, self.log = held, log
        self.probe = _probe(job.plan, seeds)
        self.batch = SeedBatch(seeds, self.probe.states, job.threads, self.plan.device)
        self.run = CurriculumRun(self.plan.stages, self.batch)
        self.progress = _Progress([[] for _ in seeds])
        self._clocks = time.perf_counter(), time.process_time()

    def train(
        self, resumes: bool, tick: Callable[[Tick], None], stop: Stop
    ) -> dict[int, str]:
        """Train, from the checkpoint if one exists; the seeds that failed, and why."""
        if resumes:
            self._resume()
        host = {"host": socket.gethostname(), "pid": os.getpid()}
        new = _incomplete(self.plan, self.seeds)
        for seed in new:
            records.write_status(self.plan, seed, RUNNING, host)
        length, saved = self.plan.length, time.monotonic()
        for pause in self.run:
            ends = isinstance(pause, Snapshot) and pause.last_of_stage
            if isinstance(pause, Snapshot):
                self.measure(pause)
                self._note_time()
                tick(Tick(pause.stage.task, pause.count, self.progress.wall))
            if ends and pause.count == length:
                break
            if stop.requested:
                self.progress.interruptions += 1
                self._save(pause.count / length)
                return {}
            if ends or time.monotonic() - saved >= self.plan.config["checkpoint_every"]:
                self._save(pause.count / length)
                saved = time.monotonic()
        failed = self._record(new)
        checkpoints.checkpoint_path(self.plan, self.seeds).unlink(missing_ok=True)
        return failed

    def measure(self, snapshot: Snapshot) -> None:
        """Append a row per seed; the last row of a seed may show its failure."""
        index, progress = self.probe.index, self.progress
        where = self.probe.place(snapshot)
        new = [
            [] if place in progress.failed else [where | metrics]
            for place, metrics in enumerate(self.probe.measure(snapshot))
        ]
        self.log(index, new)
        for rows, added in zip(progress.rows, new, strict=True):
            rows += added
        for place, why in self.probe.failed.items():
            progress.failed.setdefault(place, f"{why} at {index} {snapshot.count}")

    def _resume(self) -> None:
        """Continue from the batch's checkpoint."""
        stored = checkpoints.load_checkpoint(self.plan, self.seeds, self.run.given)
        self.run = CurriculumRun(self.plan.stages, self.batch, stored["past"])
        self.probe.kept = stored["kept"]
        rows = json.loads(stored["session"]["rows"])
        self.progress = _Progress(**stored["session"] | {"rows": rows})
        self.log(self.probe.index, rows)

    def _save(self, share: float) -> None:
        """Write the batch's checkpoint; `share`: of the run, that is done."""
        self._note_time()
        # Rows are many small values: one text takes less time and space.
        session = vars(self.progress) | {"rows": json.dumps(self.progress.rows)}
        content = {"past": self.run.state, "session": session, "kept": self.probe.kept}
        self._check_locks()
        checkpoints.save_checkpoint(
            self.plan, self.seeds, share, content, self.run.given
        )

    def _note_time(self) -> None:
        """Add the time since the last call."""
        before, now = self._clocks, (time.perf_counter(), time.process_time())
        self.progress.wall += now[0] - before[0]
        self.progress.cpu += now[1] - before[1]
        self._clocks = now

    def _check_locks(self) -> None:
        """BcrlError if the folder, and with it the locks, was taken away."""
        if not all(lock.holds() for lock in self.held.values()):
            text = "was removed or replaced while its seeds were being computed"
            raise BcrlError(f"{self.plan.directory} {text}; run the command again")

    def _record(self, new: tuple[int, ...]) -> dict[int, str]:
        """Write the files of the `new` seeds; those that diverged, and why."""
        self._note_time()
        plan, progress, failed = self.plan, self.progress, {}
        facts = self.probe.facts() | {
            "wall_seconds": progress.wall,
            "cpu_seconds": progress.cpu / len(self.seeds),  # this seed's share
            "interruptions": progress.interruptions,
            "lockstep": list(self.seeds),
            "device": plan.device,
            "success": str(success_of(plan.target)),
            "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            / 1024,
            **self.job.origin,
        }
        for place, seed in enumerate(self.seeds):
            if seed not in new:
                continue
            arrays, status = self.probe.arrays(place), COMPLETE
            if why := progress.failed.get(place) or self.probe.failed.get(place):
                failed[seed], status = why, f"failed: {why}"
                say(f"{plan.env} {plan.name}: seed {seed} {status}")
            self._check_locks()
            rows = progress.rows[place]
            records.write_seed(plan, seed, status, rows, arrays, facts)
        return failed


def _probe(plan: Plan, seeds: tuple[int, ...]) -> Probe | StepProbe:
    """The measurement of the plan's snapshots."""
    if plan.family == "DQN":
        return StepProbe(seeds, plan.tasks)
    return Probe(seeds, plan.tasks, plan.metrics)
