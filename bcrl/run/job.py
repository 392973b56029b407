"""A job: a group of seeds is trained in lockstep, checkpointed, and recorded."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import socket
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
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
from bcrl.results.loggers import Log
from bcrl.run import checkpoints, records
from bcrl.run.locks import Lock, claimed
from bcrl.run.progress import Tick, named

Seeds = tuple[int, ...]


@dataclass(frozen=True)
class Job:
    """Seeds of a plan, which are to be trained together as far as they are free."""

    number: int  # that its ticks bear
    plan: Plan
    seeds: Seeds
    threads: int
    origin: Mapping[str, Any]  # code and machine, as `records.provenance` says


@dataclass(frozen=True)
class Outcome:
    """What became of a job's seeds; those not named are complete."""

    failed: dict[int, str] = field(default_factory=dict)  # and why
    busy: Seeds = ()  # another process has them, or a checkpoint groups them otherwise
    interrupted: bool = False


@dataclass
class Session:
    """What a group has come to, besides what it has learned: a checkpoint's rest."""

    rows: list[list[dict[str, Any]]]  # of each seed's CSV
    failed: dict[int, str] = field(default_factory=dict)  # by place in the group
    wall: float = 0.0  # seconds, with those before an interruption
    cpu: float = 0.0
    interruptions: int = 0


class Clock:
    """Adds the time that passes to a session's."""

    def __init__(self, session: Session) -> None:
        self.session, self._seen = session, (time.perf_counter(), time.process_time())

    def note(self) -> None:
        """What has passed since the last time."""
        now = time.perf_counter(), time.process_time()
        self.session.wall += now[0] - self._seen[0]
        self.session.cpu += now[1] - self._seen[1]
        self._seen = now


def train(job: Job, tick: Callable[[Tick], None], stop: Stop) -> Outcome:
    """Train what is free of a job's seeds and write each one's files.

    An error ends this job alone: its seeds have failed. Asked to `stop`, it leaves a
    checkpoint, from which the next call goes on.
    """
    plan, directory = job.plan, job.plan.directory
    mine: Seeds = job.seeds
    try:
        records.begin(plan)
        with claimed(directory, job.seeds) as held:
            mine, busy, resumes = _share(job, held)
            if not mine:
                return Outcome(busy=busy)
            strict = "raise" if plan.config["strict"] else "warn"
            try:
                with (
                    loggers.opened(plan.config, directory, mine) as log,
                    np.errstate(divide=strict, over=strict, invalid=strict),
                ):
                    outcome = _train(job, mine, resumes, held, log, tick, stop)
            except Exception as error:
                _note_failure(plan, mine, error)
                raise
            checkpoints.remove_done(plan)
            return Outcome(outcome.failed, busy, outcome.interrupted)
    except Exception as error:
        if not isinstance(error, (BcrlError, MemoryError)):  # unforeseen: show where
            say(traceback.format_exc())
        who = f"{plan.env} {plan.name}, {named(mine)}"
        say(f"{who}: failed: {_reason(error)}")
        lost = [s for s in mine if not records.is_complete(directory, s)]
        return Outcome(dict.fromkeys(lost, _reason(error)))


def _share(job: Job, held: Mapping[int, Lock]) -> tuple[Seeds, Seeds, bool]:
    """The seeds to train, those to ask for again later, whether a checkpoint is there.

    A checkpoint's team goes on as a whole or not at all.
    """
    plan, busy = job.plan, tuple(s for s in job.seeds if s not in held)
    teams = checkpoints.teams(plan)
    if job.seeds in teams:
        return ((), busy, False) if busy else (job.seeds, (), True)
    done = records.is_complete
    mine = tuple(s for s in held if not done(plan.directory, s))
    if any(set(team) & set(mine) for team in teams):
        return (), job.seeds, False  # whoever made it has died meanwhile
    return mine, busy, False


def _train(
    job: Job,
    seeds: Seeds,
    resumes: bool,
    held: Mapping[int, Lock],
    log: Log,
    tick: Callable[[Tick], None],
    stop: Stop,
) -> Outcome:
    """Train seeds whose locks are held, from their checkpoint if there is one."""
    plan, probe = job.plan, probe_of(job.plan, seeds)
    team = SeedBatch(seeds, probe.states, job.threads, plan.device)
    course, session = CurriculumRun(plan.stages, team), Session([[] for _ in seeds])
    if resumes:
        stored = checkpoints.load(plan, seeds, course.given)
        course, probe.kept = (
            CurriculumRun(plan.stages, team, stored["past"]),
            stored["kept"],
        )
        rest = stored["session"] | {"rows": json.loads(stored["session"]["rows"])}
        session = Session(**rest)
        log(probe.index, session.rows)
    clock = Clock(session)
    host = {"host": socket.gethostname(), "pid": os.getpid()}
    new = [s for s in seeds if not records.is_complete(plan.directory, s)]
    for seed in new:
        records.write_status(plan, seed, "running", host)

    def save(share: float) -> None:
        clock.note()
        # Rows are many small values, packed at once.
        rest = vars(session) | {"rows": json.dumps(session.rows)}
        content = {"past": course.state, "session": rest, "kept": probe.kept}
        _check_locks(plan, held)
        checkpoints.save(plan, seeds, share, content, course.given)

    saved = time.monotonic()
    for now in course:
        ends = isinstance(now, Snapshot) and now.last_of_stage
        if isinstance(now, Snapshot):
            _measure(probe, now, session, log)
            clock.note()
            tick(Tick(job.number, now.stage.task, now.count, session.wall))
        if ends and now.count == plan.length:
            break
        if stop.asked:
            session.interruptions += 1
            save(now.count / plan.length)
            return Outcome(interrupted=True)
        if ends or time.monotonic() - saved >= plan.config["checkpoint_every"]:
            save(now.count / plan.length)
            saved = time.monotonic()
    clock.note()
    failed = _record(job, seeds, new, probe, session, held)
    checkpoints.remove(plan, seeds)
    return Outcome(failed)


def _record(
    job: Job,
    seeds: Seeds,
    new: Sequence[int],
    probe: Probe | StepProbe,
    session: Session,
    held: Mapping[int, Lock],
) -> dict[int, str]:
    """Write the files of the seeds that are `new`; those that diverged, and why."""
    plan, failed = job.plan, {}
    facts = probe.facts() | {
        "wall_seconds": session.wall,
        "cpu_seconds": session.cpu / len(seeds),  # this seed's share
        "interruptions": session.interruptions,
        "lockstep": list(seeds),
        "device": plan.device,
        "success": str(success_of(plan.target)),
        "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    for place, seed in enumerate(seeds):
        if seed not in new:
            continue
        arrays = probe.arrays(place)
        why, status = session.failed.get(place) or probe.failed.get(place), "complete"
        if why:
            failed[seed], status = why, f"failed: {why}"
            say(f"{plan.env} {plan.name}: seed {seed} {status}")
        _check_locks(plan, held)
        rows = session.rows[place]
        records.write_seed(plan, seed, status, rows, arrays, facts | job.origin)
    return failed


def _measure(
    probe: Probe | StepProbe, now: Snapshot, session: Session, log: Log
) -> None:
    """Measure a snapshot; a seed's last row is the one that shows its failure."""
    where = {"stage": now.stage.number, "task": now.stage.task, probe.index: now.count}
    rows = [where | metrics for metrics in probe.measure(now)]
    new = [[] if place in session.failed else [row] for place, row in enumerate(rows)]
    log(probe.index, new)
    for known, added in zip(session.rows, new, strict=True):
        known += added
    for place, why in probe.failed.items():
        session.failed.setdefault(place, f"{why} at {probe.index} {now.count}")


def _check_locks(plan: Plan, held: Mapping[int, Lock]) -> None:
    """BcrlError if somebody has taken the folder, and with it the locks, away."""
    if not all(lock.holds() for lock in held.values()):
        text = "was removed or replaced while its seeds were being computed"
        raise BcrlError(f"{plan.directory} {text}; run the command again")


def _note_failure(plan: Plan, seeds: Seeds, error: Exception) -> None:
    """Write why the seeds failed into their metadata, if there still is a place."""
    for seed in seeds:
        if not records.is_complete(plan.directory, seed):
            with contextlib.suppress(BcrlError):
                records.write_status(plan, seed, f"failed: {_reason(error)}", {})


def _reason(error: Exception) -> str:
    if isinstance(error, MemoryError):
        what = "try fewer workers or seeds.lockstep, or a smaller scale"
        return " ".join(f"out of memory: {error} ({what})".split())
    known = isinstance(error, BcrlError)
    return str(error) if known else f"{type(error).__name__}: {error}"


def probe_of(plan: Plan, seeds: Seeds) -> Probe | StepProbe:
    """What measures the plan's snapshots."""
    if plan.family == "DQN":
        return StepProbe(seeds, plan.tasks)
    return Probe(seeds, plan.tasks, plan.metrics)
