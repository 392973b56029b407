"""Hydra's launcher for Slurm, with jobs that resume.

It has the name and the keys of submitit's plugin. In addition it splits a variant's
seeds into jobs, leaves out complete seeds, writes checkpoints after a signal, and has
Slurm requeue preempted jobs. The results are read from the seeds' files afterwards.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NoReturn

from hydra.core.plugins import Plugins
from hydra.core.singleton import Singleton
from hydra_plugins.hydra_submitit_launcher.submitit_launcher import SlurmLauncher

from bcrl.common.signals import EXIT_CODE, Interrupted, Stop
from bcrl.common.terminal import say
from bcrl.config.jobs import plan_of_job
from bcrl.config.plan import part
from bcrl.errors import BcrlError, ConfigError
from bcrl.run import records

_COMMANDS = ("sbatch", "srun", "squeue")  # of Slurm's, that must exist here
_PATIENCE = 1800.0  # seconds that squeue may fail, as while Slurm restarts
_ARRAY = 1000  # jobs per array: Slurm's MaxArraySize is 1001 unless a site changed it


class Unattended(BcrlError):
    """The command ends while Slurm still has jobs of it."""

    exit_code = 3


class Slurm(SlurmLauncher):
    """Jobs as Slurm's arrays; a preempted job saves and is requeued."""

    def __init__(self, seeds_per_job: int | None = None, **params: Any) -> None:
        super().__init__(**params)
        self.seeds_per_job = seeds_per_job
        self.argv = sys.argv

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence:
        """Submit the jobs that are not complete and wait until the last one ends."""
        if missing := [name for name in _COMMANDS if not shutil.which(name)]:
            why = f"there is no {', '.join(missing)} here: run it on a login node"
            raise ConfigError("hydra/launcher", "slurm", why)
        jobs = self._divided(job_overrides)
        folder = self.params["submitit_folder"]
        executor = self._executor(folder)
        state = Singleton.get_state()
        rows = [(job, "hydra.sweep.dir", n, "", state) for n, job in enumerate(jobs)]
        arrays: list[str] = []
        stop = Stop()
        with stop.on_signals():
            for first in range(0, len(rows), _ARRAY):
                some = rows[first : first + _ARRAY]
                try:
                    submitted = executor.map_array(self, *zip(*some, strict=True))
                except (RuntimeError, OSError) as error:
                    if stop.requested:  # Ctrl-C also ends a hanging sbatch
                        break
                    raise _rejected(error, arrays, first, len(rows)) from error
                arrays.append(submitted[0].job_id.partition("_")[0])
                count = f"{len(some)} job{'s' * (len(some) > 1)}"
                say(f"Slurm: {count} as {arrays[-1]}; logs in {folder}")
                if stop.requested:
                    break
            if arrays or stop.requested:
                _wait(arrays, self.config.progress != "none", stop)
        return []

    def _executor(self, folder: str) -> Any:
        """Submitit's executor with the parameters of the YAML."""
        import submitit  # takes a second

        params = {f"slurm_{key}": value for key, value in self.params.items()}
        del params["slurm_submitit_folder"]
        timeouts = params.pop("slurm_max_num_timeout")
        executor = submitit.AutoExecutor(
            folder, "slurm", slurm_max_num_timeout=timeouts
        )
        # Since Slurm 22.05 each step has one core unless it asks for more.
        srun = [f"--cpus-per-task={self.params['cpus_per_task']}"]
        more = {"requeue": True}  # also after a node's failure
        params |= {"slurm_srun_args": srun, "slurm_additional_parameters": more}
        executor.update_parameters(**params)
        return executor

    def _divided(self, jobs: Sequence[Sequence[str]]) -> list[list[str]]:
        """Each job's overrides, once per part of its seeds that isn't complete."""
        load = self.hydra_context.config_loader.load_sweep_config
        size, divided = self.seeds_per_job, []
        for overrides in map(list, jobs):
            config = load(self.config, overrides)
            plan = plan_of_job(config, config.hydra)
            parts: list[str | None] = [None]
            if size and config.seeds.part is None:
                number = -(-len(plan.seeds) // size)
                parts = [f"{k}/{number}" for k in range(1, number + 1)]
            for which in parts:
                seeds = part(plan.seeds, which)
                if records.pending(replace(plan, seeds=seeds)):
                    added = [f"seeds.part={which}"] if which else []
                    divided.append([*overrides, *added])
        return divided

    def __call__(self, *arguments: Any) -> NoReturn:
        """Run one job in a process of Slurm's."""
        import submitit

        sys.argv = self.argv  # results name the command that submitted them
        try:
            code = super().__call__(*arguments).return_value
        except Interrupted:
            own = f"--jobs={os.environ['SLURM_JOB_ID']}"
            now = _squeue(own, "--format=%T %r")[0] or ""
            # Neither after scancel nor where Slurm requeues the job by itself.
            if now.startswith("RUNNING") or now.endswith("TimeLimit"):
                usual = f"SIG{submitit.JobEnvironment.USR_SIG}"
                signal.raise_signal(signal.Signals[usual])  # submitit requeues it
            code = EXIT_CODE
        sys.exit(code)  # nobody waits for a result


def _rejected(error: Exception, arrays: Sequence[str], taken: int, n: int) -> BcrlError:
    """The error to raise if sbatch fails, perhaps after it took some arrays."""
    words = " ".join(str(error).split())
    if not arrays:
        return BcrlError(f"Slurm rejects the jobs, none was submitted: {words}")
    names = " ".join(arrays)
    return Unattended(
        f"Slurm took {taken} of {n} jobs, as {names}, and rejects the rest: {words}\n"
        f"`scancel {names}` ends them; once they are over, run the same command again "
        "to submit the incomplete rest"
    )


def _wait(arrays: Sequence[str], telling: bool, stop: Stop) -> None:
    """Wait until no array has a job waiting or running; a signal interrupts."""
    pause, before, answered = 1.0, "", time.monotonic()
    names = " ".join(arrays)
    while not stop.requested:
        listed, why = _squeue("--me", "--array", "--format=%F %T")
        if listed is None:
            if before != why:
                say(f"Slurm: squeue fails, trying again: {why}")
            pause, before = min(30.0, 1.2 * pause), why
            if time.monotonic() > answered + _PATIENCE:
                text = f"squeue has failed for {_PATIENCE / 60:.0f} minutes: {why}"
                more = f"the jobs of {names} may still run (--status shows it)"
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
        say(f"bcrl: Slurm continues with the jobs; `scancel {names}` ends them")
    raise Interrupted


def _squeue(*options: str) -> tuple[str | None, str]:
    """Slurm's queue, or None and why squeue fails, as while Slurm restarts."""
    command: Any = ["squeue", "--noheader", *options]
    decoding: Any = {"encoding": "utf-8", "errors": "replace"}
    try:
        done = subprocess.run(command, capture_output=True, timeout=60, **decoding)
    except (OSError, subprocess.TimeoutExpired) as error:
        return None, str(error)
    if done.returncode:
        return None, " ".join(done.stderr.split()) or f"exit code {done.returncode}"
    return done.stdout.strip(), ""


def register_slurm() -> None:
    """Have Hydra make this launcher where the plugin's is named."""
    usual = f"{SlurmLauncher.__module__}.{SlurmLauncher.__name__}"
    Plugins.instance().class_name_to_class[usual] = Slurm
