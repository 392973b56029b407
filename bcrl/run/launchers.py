"""Hydra's launchers for processes and for Slurm, made fit for jobs that can go on.

They go by the names and keys of the plugins' own. Besides, a variant's seeds are split
into jobs, what is complete isn't launched, a signal ends in checkpoints, and Slurm puts
back what had to leave. What has become of the seeds is read from their files, not here.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import active_children
from typing import Any, NoReturn

from hydra.core.plugins import Plugins
from hydra.core.singleton import Singleton
from hydra_plugins.hydra_joblib_launcher.joblib_launcher import JoblibLauncher
from hydra_plugins.hydra_submitit_launcher.submitit_launcher import SlurmLauncher
from omegaconf import DictConfig

from bcrl.common.signals import EXIT_CODE, Interrupted, Stop
from bcrl.common.terminal import say
from bcrl.config import jobs as planning
from bcrl.config import plan as compose
from bcrl.errors import BcrlError, ConfigError
from bcrl.run import records
from bcrl.run.workers import cores

COMMANDS = ("sbatch", "srun", "squeue")  # of Slurm's, that have to be here
PATIENCE = 1800.0  # seconds that squeue may fail, as while Slurm restarts
ARRAY = 1000  # jobs of one array: Slurm's MaxArraySize is 1001 unless a site says more
Jobs = Sequence[Sequence[str]]  # each one's overrides


class Unattended(BcrlError):
    """Slurm has jobs of this command, which ends before them."""

    exit_code = 3


class Local(JoblibLauncher):
    """Jobs in processes of this machine, so that jobs × workers × threads = cores."""

    def __init__(
        self, n_jobs: int | None = None, seeds_per_job: int | None = None, **rest: Any
    ) -> None:
        super().__init__(n_jobs=_count("n_jobs", n_jobs), **rest)
        self.seeds_per_job = _count("seeds_per_job", seeds_per_job)

    def launch(self, job_overrides: Jobs, initial_job_idx: int) -> Sequence:
        jobs = _divided(self, job_overrides, self.seeds_per_job)
        if not jobs:
            return []
        each = max(1, cores() // self.config.workers)
        at_once = min(self.joblib["n_jobs"] or each, len(jobs))
        self.joblib["n_jobs"] = at_once
        if self.config.threads is None:
            jobs = [[*job, f"threads={max(1, each // at_once)}"] for job in jobs]
        self.task_function = partial(_unless_stopped, self.task_function)
        stop = _PassedOn()
        with stop.on_signals(second_ends_all=True):
            try:
                return super().launch(jobs, initial_job_idx)
            except BrokenExecutor as error:
                if not stop.asked:
                    say(f"bcrl: a process died, all jobs have ended: {error}")
                return []
            finally:
                if stop.asked:
                    raise Interrupted


class _PassedOn(Stop):
    """A wish to stop that this process's children are told of."""

    def ask(self) -> None:
        super().ask()
        for process in active_children():
            process.terminate()


_stop = Stop()  # of a process that joblib gives one job after the other


def _unless_stopped(job: Callable[[DictConfig], None], config: DictConfig) -> None:
    """Do a job; a process that was told to stop saves, and begins no other.

    An exception would have joblib kill the other processes while they save.
    """
    if not _stop.asked:
        _stop.on_signals(second_ends_all=False).__enter__()  # also between jobs
        try:
            job(config)
        except Interrupted:
            _stop.ask()


class Slurm(SlurmLauncher):
    """Jobs as Slurm's arrays; one that has to leave saves, and is put back."""

    def __init__(self, seeds_per_job: int | None = None, **params: Any) -> None:
        super().__init__(**params)
        self.seeds_per_job = _count("seeds_per_job", seeds_per_job)
        self.argv = sys.argv

    def launch(self, job_overrides: Jobs, initial_job_idx: int) -> Sequence:
        import submitit  # late, as the plugin does: a second

        if missing := [name for name in COMMANDS if not shutil.which(name)]:
            why = f"there is no {', '.join(missing)} here: run it on a login node"
            raise ConfigError("hydra/launcher", "slurm", why)
        jobs = _divided(self, job_overrides, self.seeds_per_job)
        params = {f"slurm_{key}": value for key, value in self.params.items()}
        folder = params.pop("slurm_submitit_folder")
        timeouts = params.pop("slurm_max_num_timeout")
        executor = submitit.AutoExecutor(
            folder, "slurm", slurm_max_num_timeout=timeouts
        )
        # Since Slurm 22.05 a step has one core unless it says how many.
        srun = [f"--cpus-per-task={self.params['cpus_per_task']}"]
        more = {"requeue": True}  # also after a node's failure
        params |= {"slurm_srun_args": srun, "slurm_additional_parameters": more}
        executor.update_parameters(**params)
        state = Singleton.get_state()
        rows = [(job, "hydra.sweep.dir", n, "", state) for n, job in enumerate(jobs)]
        arrays: list[str] = []
        stop = Stop()
        with stop.on_signals(second_ends_all=True):
            for first in range(0, len(rows), ARRAY):
                some = rows[first : first + ARRAY]
                try:
                    submitted = executor.map_array(self, *zip(*some, strict=True))
                except (RuntimeError, OSError) as error:
                    if stop.asked:  # Ctrl-C ends a hanging sbatch, too
                        break
                    raise _refused(error, arrays, first, len(rows)) from error
                arrays.append(submitted[0].job_id.partition("_")[0])
                count = f"{len(some)} job{'s' * (len(some) > 1)}"
                say(f"Slurm: {count} as {arrays[-1]}; logs in {folder}")
                if stop.asked:
                    break
            if arrays or stop.asked:
                _wait(arrays, self.config.progress != "none", stop)
        return []

    def __call__(self, *arguments: Any) -> NoReturn:
        import submitit

        sys.argv = self.argv  # a result says which command it comes from
        try:
            code = super().__call__(*arguments).return_value
        except Interrupted:
            own = f"--jobs={os.environ['SLURM_JOB_ID']}"
            now, _ = _squeue(own, "--format=%T %r")
            now = now or ""
            # Not where somebody has ended it, or Slurm puts it back by itself.
            if now.startswith("RUNNING") or now.endswith("TimeLimit"):
                usual = f"SIG{submitit.JobEnvironment.USR_SIG}"
                signal.raise_signal(signal.Signals[usual])  # submitit puts it back
            code = EXIT_CODE
        sys.exit(code)  # nobody waits for a result


def _refused(error: Exception, arrays: Sequence[str], taken: int, n: int) -> BcrlError:
    """What to say if sbatch fails, perhaps after some arrays were submitted."""
    words = " ".join(str(error).split())
    if not arrays:
        return BcrlError(f"Slurm refuses the jobs, none was submitted: {words}")
    return Unattended(
        f"Slurm took {taken} of {n} jobs, as {' '.join(arrays)}, and refuses the rest: "
        f"{words}\n`scancel {' '.join(arrays)}` ends them; once they are over, the "
        "same command submits what isn't complete then"
    )


def _wait(arrays: Sequence[str], telling: bool, stop: Stop) -> None:
    """Until none of the arrays has a job waiting or running; a signal interrupts."""
    pause, before, answered = 1.0, "", time.monotonic()
    while not stop.asked:
        listed, why = _squeue("--me", "--array", "--format=%F %T")
        if listed is None:
            if before != why:
                say(f"Slurm: squeue fails, it is asked again: {why}")
            pause, before = min(30.0, 1.2 * pause), why
            if time.monotonic() > answered + PATIENCE:
                text = f"squeue has failed for {PATIENCE / 60:.0f} minutes: {why}"
                more = f"what it had of {' '.join(arrays)} may run on (--status tells)"
                raise Unattended(f"{text}; {more}")
        else:
            answered = time.monotonic()
            jobs = [line.split() for line in listed.splitlines()]
            states = Counter(state for array, state in jobs if array in arrays)
            if not states:
                return
            now = ", ".join(f"{n} {s.lower()}" for s, n in sorted(states.items()))
            pause = 1.0 if now != before else min(30.0, 1.2 * pause)
            if telling and now != before:
                say(f"Slurm: {now}")
            before = now
        time.sleep(pause)
    if arrays:
        say(f"bcrl: Slurm goes on with it; `scancel {' '.join(arrays)}` ends it")
    raise Interrupted


def _squeue(*options: str) -> tuple[str | None, str]:
    """What Slurm's queue says, or None and why it doesn't, as while Slurm restarts."""
    command = ["squeue", "--noheader", *options]
    try:
        done = subprocess.run(
            command, capture_output=True, encoding="utf-8", errors="replace", timeout=60
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return None, str(error)
    if done.returncode:
        return None, " ".join(done.stderr.split()) or f"exit code {done.returncode}"
    return done.stdout.strip(), ""


def _count(key: str, value: object) -> int | None:
    """A number of at least 1, or None; ConfigError for anything else."""
    if value is None or (type(value) is int and value >= 1):
        return value
    why = "must be a number of at least 1, or null"
    raise ConfigError(f"hydra.launcher.{key}", value, why)


def _divided(launcher: Local | Slurm, jobs: Jobs, size: int | None) -> list[list[str]]:
    """Each job's overrides, once for each part of its seeds that isn't complete."""
    load = launcher.hydra_context.config_loader.load_sweep_config
    divided = []
    for overrides in map(list, jobs):
        config = load(launcher.config, overrides)
        plan = planning.plan_of_job(config, config.hydra)
        parts: list[str | None] = [None]
        if size and config.seeds.part is None:
            number = -(-len(plan.seeds) // size)
            parts = [f"{k}/{number}" for k in range(1, number + 1)]
        for part in parts:
            seeds = compose.part(plan.seeds, part)
            if records.pending(replace(plan, seeds=seeds)):
                divided.append([*overrides, *([f"seeds.part={part}"] if part else [])])
    return divided


def register() -> None:
    """Have Hydra make these launchers where the plugins' are asked for."""
    known = Plugins.instance().class_name_to_class
    for own in (Local, Slurm):
        usual = own.__bases__[0]
        known[f"{usual.__module__}.{usual.__name__}"] = own
