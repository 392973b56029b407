"""Jobs of the suite, one per environment, curriculum and method, and their files."""

import hashlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from tqdm import tqdm

from bcrl.api import read, run, stages
from bcrl.common.files import make_directory, write_text
from bcrl.common.signals import EXIT_CODE, Stop
from bcrl.errors import BcrlError
from bcrl.run.origin import run_origin
from bcrl.run.workers import do_jobs
from research.misleading_tasks import (
    ALONE,
    IN_MATRIX,
    METHODS,
    ONLY,
    WITH_SOURCE,
    Setting,
)


@dataclass(frozen=True)
class Job:
    """The seeds of one method in one curriculum."""

    env: str
    curriculum: str
    method: str
    slots: tuple[tuple[Any, Any], ...]  # task and learner of each
    seeds: tuple[int, ...]
    seconds: float  # of CPU time, estimated

    def path(self, out: Path) -> Path:
        """Its CSV; the name has a hash of all settings and seeds, so that other
        settings have another file."""
        text = repr((self.slots, METHODS[self.method], self.seeds))
        mark = hashlib.sha256(text.encode()).hexdigest()[:10]
        folder = out / self.env / _slug(self.curriculum)
        return folder / f"{_slug(self.method)}-{mark}.csv"


def _slug(name: str) -> str:
    return re.sub(r"[^\w.]+", "_", name)


def jobs_of(env: str, setting: Setting, seeds: Sequence[int]) -> list[Job]:
    """The jobs of an environment: all scenarios and the matrix."""
    wanted = dict.fromkeys(
        (name, tasks, method)
        for name, tasks in setting.curricula().items()
        for method in (ALONE if name == ONLY else WITH_SOURCE)
    )
    for goal, target in setting.matrix_tasks().items() if setting.matrix else ():
        for source, task in setting.matrix_tasks().items():
            alone, tasks = source == goal, (task, target)
            for method in ALONE if alone else IN_MATRIX:
                name = cell(source, goal)
                wanted[name, tasks[1:] if alone else tasks, method] = None
    found = []
    for name, tasks, method in wanted:
        slots = tuple(setting.slots(tasks, method))
        cost = setting.seconds * len(seeds)
        found.append(Job(env, name, method, slots, tuple(seeds), cost))
    return found


def cell(source: str, goal: str) -> str:
    """The curriculum of a cell of the matrix."""
    if goal == "target":
        return ONLY if source == goal else source
    return f"{goal} only" if source == goal else f"{source} to {goal}"


def train(jobs: Sequence[Job], out: Path, workers: int) -> int:
    """Run the jobs that have no file yet, the longest first; the exit code."""
    missing = [job for job in jobs if not job.path(out).exists()]
    missing.sort(key=lambda job: -job.seconds)
    code = run_origin()["git"]
    revision = f"{code['revision'] or ''}{' with changes' * bool(code['dirty'])}"
    todo = [(job, str(job.path(out)), revision) for job in missing]
    for job in missing:
        make_directory(job.path(out).parent, "--out")
    failures: list[str] = []
    stop = Stop()
    total = sum(job.seconds for job in jobs)
    done = total - sum(job.seconds for job in missing)
    shown = "{desc} {percentage:3.0f} %|{bar}| {elapsed}, {remaining} left"
    look = {"total": total, "initial": done, "bar_format": shown}
    with stop.on_signals(), tqdm(**look) as bar:
        for number, failure in do_jobs(_run, todo, workers, lambda *_: None, stop):
            job = missing[number]
            bar.set_description_str(f"{job.env} {job.curriculum} {job.method}")
            bar.update(job.seconds)
            if failure:
                failures.append(f"{job.env}, {job.curriculum}, {job.method}: {failure}")
    for failure in failures:
        print(failure)
    return EXIT_CODE if stop.requested else int(bool(failures))


def _run(given: tuple[Job, str, str], report: Callable, stop: Any) -> str:
    """Train a job and write its CSV; why it failed, if it did."""
    job, path, revision = given
    tasks, learners = zip(*job.slots, strict=True)
    try:
        course = stages(tasks, learners, *METHODS[job.method])
        frame = run(course, job.seeds, ("return",), threads=1, progress=False)
    except BcrlError as error:
        return str(error)
    kept = [x for x in frame if x in COLUMNS]
    frame = frame[kept].assign(revision=revision)
    write_text(Path(path), frame.to_csv(index=False, lineterminator="\n"))
    return ""


COLUMNS = ("seed", "stage", "iteration", "step", "return", "alpha", "base_fit")


def load(jobs: Sequence[Job], out: Path) -> dict[tuple[str, str, str], pd.DataFrame]:
    """Environment, curriculum and method → its frame, of the jobs that have one."""
    found = {}
    for job in jobs:
        if (path := job.path(out)).exists():
            found[job.env, job.curriculum, job.method] = read(path)
    return found
