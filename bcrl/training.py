"""A job: a group of seeds is trained in lockstep, checkpointed, and recorded."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import socket
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from bcrl import checkpoints, records
from bcrl.compose import Plan
from bcrl.errors import BcrlError
from bcrl.evaluation import StepProbe
from bcrl.interrupts import Stop
from bcrl.locks import Lock, claimed
from bcrl.probes import Probe
from bcrl.progress import Tick, named
from bcrl.stage import Course, Snapshot, Team

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
    wall: float = 0.0  # seconds, of all sessions
    cpu: float = 0.0
    interruptions: int = 0


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
            try:
                outcome = _train(job, mine, resumes, held, tick, stop)
            except Exception as error:
                _note_failure(plan, mine, error)
                raise
            checkpoints.remove_done(plan)
            return Outcome(outcome.failed, busy, outcome.interrupted)
    except Exception as error:
        if not isinstance(error, BcrlError):  # unforeseen: show where it came from
            traceback.print_exc()
        who = f"{plan.env} {plan.name}, {named(mine)}"
        print(f"{who}: failed: {_reason(error)}", file=sys.stderr)
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
    tick: Callable[[Tick], None],
    stop: Stop,
) -> Outcome:
    """Train seeds whose locks are held, from their checkpoint if there is one."""
    plan, began = job.plan, time.perf_counter()
    cpu = time.process_time()
    probe = probe_of(plan, seeds)
    team = Team(seeds, probe.states, job.threads, plan.device)
    course, session = Course(plan.stages, team), Session([[] for _ in seeds])
    if resumes:
        stored = checkpoints.load(plan, seeds, course.given)
        course = Course(plan.stages, team, stored["past"])
        rest = stored["session"] | {"rows": json.loads(stored["session"]["rows"])}
        session, probe.kept = Session(**rest), stored["kept"]
    new = [s for s in seeds if not records.is_complete(plan.directory, s)]
    host = {"host": socket.gethostname(), "pid": os.getpid()}
    for seed in new:
        records.write_status(plan, seed, "running", host)
    before = session.wall, session.cpu

    def save(interrupted: bool) -> None:
        session.wall = before[0] + time.perf_counter() - began
        session.cpu = before[1] + time.process_time() - cpu
        rest = vars(session) | {
            "interruptions": session.interruptions + interrupted,
            "rows": json.dumps(session.rows),  # many small values, packed at once
        }
        content = {"past": course.past, "session": rest, "kept": probe.kept}
        _check_locks(plan, held)
        checkpoints.save(plan, seeds, content, course.given)

    saved = time.monotonic()
    for now in course:
        ends = isinstance(now, Snapshot) and now.last_of_stage
        if isinstance(now, Snapshot):
            _look(probe, now, session)
            spent = before[0] + time.perf_counter() - began
            tick(Tick(job.number, now.stage.task, now.count, spent))
        done = ends and now.count == plan.length
        due = time.monotonic() - saved >= plan.config["checkpoint_every"]
        if stop.asked and not done:
            save(interrupted=True)
            return Outcome(interrupted=True)
        if (due or ends) and not done:
            save(interrupted=False)
            saved = time.monotonic()
    facts = probe.facts() | {
        "wall_seconds": before[0] + time.perf_counter() - began,
        "cpu_seconds": (before[1] + time.process_time() - cpu) / len(seeds),  # a share
        "interruptions": session.interruptions,
        "lockstep": list(seeds),
        "device": plan.device,
        "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    failed = {}
    for place, seed in enumerate(seeds):
        if seed not in new:
            continue
        why, status = session.failed.get(place), "complete"
        if why:
            failed[seed], status = why, f"failed: {why}"
            print(f"{plan.env} {plan.name}: seed {seed} {status}", file=sys.stderr)
        _check_locks(plan, held)
        arrays = probe.arrays(place)
        rows = session.rows[place]
        records.write_seed(plan, seed, status, rows, arrays, facts | job.origin)
    return Outcome(failed)


def _look(probe: Probe | StepProbe, now: Snapshot, session: Session) -> None:
    """Measure a snapshot; a seed's last row is the one that shows its failure."""
    where = {"stage": now.stage.number, "task": now.stage.task, probe.index: now.count}
    for place, metrics in enumerate(probe.measure(now)):
        if place not in session.failed:
            session.rows[place].append(where | metrics)
    for place, why in now.failed.items():
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
    known = isinstance(error, BcrlError)
    return str(error) if known else f"{type(error).__name__}: {error}"


def probe_of(plan: Plan, seeds: Seeds) -> Probe | StepProbe:
    """What measures the plan's snapshots."""
    if plan.family == "DQN":
        return StepProbe(seeds, plan.tasks)
    return Probe(seeds, plan.tasks, plan.metrics)
