"""A job: a batch of seeds is trained in lockstep, checkpointed, and recorded."""

import json
import os
import socket
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from resource import RUSAGE_SELF, getrusage
from typing import Any

import numpy as np

from bcrl.common.serialization import read_content
from bcrl.common.signals import Stop
from bcrl.common.terminal import say
from bcrl.errors import BcrlError
from bcrl.evaluation.metrics import Probe
from bcrl.evaluation.step_metrics import StepProbe
from bcrl.learning.learned import packed
from bcrl.learning.rollout import success_of
from bcrl.learning.stage import CurriculumRun, RunState, SeedBatch, Snapshot
from bcrl.q.functions import Q
from bcrl.results import loggers
from bcrl.results.layout import COMPLETE, INDEX, RUNNING
from bcrl.run import agent_files, checkpoints, extension, locks, records
from bcrl.run.progress import Tick
from bcrl.run.schedule import Job

_ALL = ("stages", "state")  # values of `keep` with which agents have all residuals


def train(job: Job, tick: Callable[[Tick], None], stop: Stop) -> dict[int, str]:
    """Train those of a job's seeds that are free and write each one's files.

    Returns the seeds that failed, and why: all of them after an error. After a request
    to `stop` it leaves a checkpoint, from which the next call resumes.
    """
    plan, seeds = job.plan, job.seeds
    strict = "raise" if plan.config["strict"] else "warn"
    try:
        records.make_run_directory(plan)
        with (
            locks.claimed(plan.directory, seeds) as held,
            np.errstate(divide=strict, over=strict, invalid=strict),
        ):
            begun = checkpoints.batches(plan)
            if resumes := seeds in begun:  # as a whole, so it needs all of its locks
                busy = len(held) < len(seeds)
            else:  # the seeds of a checkpoint belong to a separate job
                seeds = tuple(records.pending(plan, held))
                busy = any(set(batch) & set(seeds) for batch in begun)
            if not seeds or busy:
                return {}
            job = replace(job, seeds=seeds, resumes=resumes)
            index = INDEX[plan.family][-1]
            with loggers.opened(plan.config, plan.directory, seeds, index) as log:
                try:
                    failed = _Training(job, held, log).train(tick, stop)
                except Exception as error:
                    for seed in records.pending(plan, seeds):
                        with suppress(BcrlError):  # the folder may be gone
                            status = f"failed: {_reason(error)}"
                            records.write_status(plan, seed, status, {})
                    raise
            checkpoints.remove_done(plan)
            return failed
    except Exception as error:
        if not isinstance(error, (BcrlError, MemoryError)):  # unforeseen: show where
            say(traceback.format_exc())
        why = _reason(error)
        say(f"{plan.env} {plan.name}, {records.named(seeds)}: failed: {why}")
        return dict.fromkeys(records.pending(plan, seeds), why)


def _reason(error: Exception) -> str:
    if isinstance(error, MemoryError):
        text = f"out of memory: {error} (try fewer workers or seeds.lockstep)"
        return " ".join(text.split())
    known = isinstance(error, BcrlError)
    return str(error) if known else f"{type(error).__name__}: {error}"


class _Training:
    """The training of a job's seeds, whose locks are `held`."""

    def __init__(self, job: Job, held: dict[int, locks.Lock], log: loggers.Log) -> None:
        self.job, self.held, self.log = job, held, log
        self.plan, self.seeds = plan, seeds = job.plan, job.seeds
        dqn, common = plan.family == "DQN", (seeds, plan.tasks)
        self.probe: Probe | StepProbe
        self.probe = StepProbe(*common) if dqn else Probe(*common, plan.metrics)
        batch = SeedBatch(seeds, self.probe.states, job.threads, plan.device)
        earlier = plan.source.all_stages if plan.source else ()
        begun = RunState(0, None if job.resumes else agent_files.start(plan, batch))
        self.run = CurriculumRun(plan.stages, batch, begun, earlier=earlier)
        self.rows: list[list[dict[str, Any]]] = [[] for _ in seeds]  # of the CSVs
        self.residuals: list[Q] = []  # ϱ of the stages that an agent keeps
        self.failed: dict[int, str] = {}  # by place in the batch
        #: By name, stage and place: why α was not searched, how folding changed Q.
        self.notes: dict[tuple[str, int, int], Any] = {}
        self.interruptions = 0
        self._began = _clocks()  # minus what was spent before an interruption
        self._path = checkpoints.checkpoint_path(plan, seeds)
        if job.resumes:
            stored = read_content(self._path, self.run.given, plan.device)
            self.run.state = stored["past"]
            self.probe.kept, self.failed = stored["kept"], stored["failed"]
            self.residuals, self.notes = stored["residuals"], stored["notes"]
            self.rows, self.interruptions = json.loads(stored["rows"]), stored["stops"]
            self._began -= stored["spent"]
            log(self.rows)
            done = [s for s in plan.stages if s.number <= self.run.state.stages]
            if self._keeps_all and (lost := len(done) - len(self.residuals)) > 0:
                why = "it was interrupted with another keep=; its agents lack the "
                say(f"{plan.env} {plan.name}: {why}residuals of {lost} earlier stages")

    @property
    def _keeps_all(self) -> bool:
        """Whether agents keep the residuals of all stages, not only the last one's."""
        config = self.plan.config
        return config["boosting"]["name"] != "off" or config["keep"] in _ALL

    def train(self, tick: Callable[[Tick], None], stop: Stop) -> dict[int, str]:
        """Train to the end or until `stop`; the seeds that failed, and why."""
        host = {"host": socket.gethostname(), "pid": os.getpid()}
        new = records.pending(self.plan, self.seeds)
        for seed in new:
            records.write_status(self.plan, seed, RUNNING, host)
        length, saved = self.plan.length, time.monotonic()
        for pause in self.run:
            ends = isinstance(pause, Snapshot) and pause.last_of_stage
            if isinstance(pause, Snapshot):
                self.measure(pause)
                wall = float((_clocks() - self._began)[0])
                tick(Tick(pause.stage.task, pause.count, wall))
            if ends and pause.count == length:
                break
            if stop.requested:
                self.interruptions += 1
                self._save()
                return {}
            if ends or time.monotonic() - saved >= self.plan.config["checkpoint_every"]:
                self._save()
                saved = time.monotonic()
        failed = self._record(new)
        self._path.unlink(missing_ok=True)
        return failed

    def measure(self, snapshot: Snapshot) -> None:
        """Append a row per seed; a failed seed's last row shows the failure."""
        index, new = self.probe.index, [[row] for row in self.probe.rows(snapshot)]
        for place in self.failed:
            new[place] = []
        self.log(new)
        for rows, added in zip(self.rows, new, strict=True):
            rows += added
        for place, why in self.probe.failed.items():
            self.failed.setdefault(place, f"{why} at {index} {snapshot.count}")
        if snapshot.last_of_stage:
            number, folded = snapshot.stage.number, snapshot.folded
            own = snapshot.result.residual
            if snapshot.searched is not None:
                for place, why in snapshot.searched.reasons.items():
                    self.notes["line_search", number, place] = why
            if folded is not None:
                for place in range(len(self.seeds)):
                    self.notes["fold", number, place] = folded.facts(place)
            whole = self.plan.config["keep"] in _ALL
            own = folded.residual if folded is not None and whole else own
            earlier = self.residuals if self._keeps_all else []
            # What is folded takes the place of all residuals.
            self.residuals = [*(earlier if folded is None or whole else ()), own]

    def _save(self) -> None:
        self._check_locks()
        content, given = self._content(self.run.state), self.run.given
        checkpoints.save_checkpoint(self.plan, self.seeds, content, given)

    def _content(self, past: RunState) -> dict[str, Any]:
        """All that a run needs to resume at `past`."""
        rows = json.dumps(self.rows)  # faster and smaller as one text
        content = {"past": past, "kept": self.probe.kept, "rows": rows}
        content |= {"residuals": self.residuals, "spent": _clocks() - self._began}
        content |= {"failed": self.failed, "notes": self.notes}
        return content | {"stops": self.interruptions}

    def _check_locks(self) -> None:
        """BcrlError if the folder, and with it the locks, was taken away."""
        if not all(lock.holds() for lock in self.held.values()):
            raise BcrlError(f"{self.plan.directory} was removed or replaced; run again")

    def _record(self, new: Sequence[int]) -> dict[int, str]:
        """Write the files of the `new` seeds; those that diverged, and why."""
        plan, failed = self.plan, dict[int, str]()
        wall, cpu = map(float, _clocks() - self._began)
        share = cpu / len(self.seeds)  # this seed's
        facts = self.probe.facts() | {"wall_seconds": wall, "cpu_seconds": share}
        facts |= {"interruptions": self.interruptions, "lockstep": list(self.seeds)}
        facts |= {"device": plan.device, "success": str(success_of(plan.target))}
        facts |= {"peak_memory_mib": getrusage(RUSAGE_SELF).ru_maxrss / 1024}
        facts |= self.job.origin
        arrays = [self.probe.arrays(place) for place in range(len(self.seeds))]
        lost = self.probe.failed | self.failed  # their episodes may fail, too
        if plan.config["keep"] == "state" and not lost:
            self._check_locks()  # a complete seed never lacks its state: this is first
            extension.keep(plan, self.run, self._content(self.run.ending))
        for place, seed in enumerate(self.seeds):
            if seed not in new:
                continue
            status = COMPLETE
            if why := lost.get(place):
                failed[seed], status = why, f"failed: {why}"
                say(f"{plan.env} {plan.name}: seed {seed} {status}")
            agent, own = self._agent(place) if seed not in failed else (None, {})
            for (name, stage, of), note in self.notes.items():
                if of == place:
                    own[name] = own.get(name, {}) | {stage: note}
            found = self.rows[place], arrays[place], facts | own, agent
            self._check_locks()
            records.write_seed(plan, seed, status, *found)
        return failed

    def _agent(self, place: int) -> tuple[bytes | None, dict[str, Any]]:
        """The agent's file of the seed at `place`; without one, why there is none."""
        result = self.run.state.result
        if self.plan.config["keep"] == "none" or result is None:
            return None, {"no_agent": "its run had keep=none"}
        try:
            stages = self.plan.all_stages
            own = stages, self.run.batch, result, self.residuals, place
            return packed(*own), {}
        except TypeError as error:  # of a user's own class
            why = "mark the class @storable, and fields with an entry per seed with "
            return None, {"no_agent": f"{error}: {why}seeds_on (docs/howto/own.md)"}


def _clocks() -> np.ndarray:
    """Seconds of wall-clock time and of this process's CPU time."""
    return np.array([time.perf_counter(), time.process_time()])
