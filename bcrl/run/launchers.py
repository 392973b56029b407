"""Slurm's jobs: the incomplete seeds of plans as submitit's job arrays, which resume.

A job writes checkpoints after a signal, and Slurm requeues it if it was preempted.
"""

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

import submitit

from bcrl.common.signals import EXIT_CODE, Interrupted, Stop
from bcrl.common.terminal import say
from bcrl.config.plan import Plan, part, usable_device
from bcrl.errors import BcrlError, ConfigError
from bcrl.run import records, runner
from bcrl.run.schedule import merged

_PATIENCE = 1800.0  # seconds that squeue may fail, as while Slurm restarts
_ARRAY = 1000  # jobs per array: Slurm's MaxArraySize is 1001 unless a site changed it


class Unattended(BcrlError):
    """The command ends while Slurm still has jobs of it."""

    exit_code = 3


class _SlurmJob(submitit.helpers.Checkpointable):
    """What a process of Slurm's calls, once more after each requeueing."""

    def __call__(self, plan: Plan, command: list[str]) -> NoReturn:
        sys.argv = command  # results name the command that submitted them
        code = 0
        try:
            device = usable_device(plan.config["device"], plan.family)  # of this node
            runner.run(replace(plan, device=device))
        except BcrlError as error:
            say(f"bcrl: {error}")
            code = error.exit_code
        except Interrupted:
            job = os.environ["SLURM_JOB_ID"]
            now = _squeue(f"--jobs={job}", "--format=%T %r")[0] or ""
            # Neither after scancel nor where Slurm requeues the job by itself.
            if now.startswith("RUNNING") or now.endswith("TimeLimit"):
                usual = f"SIG{submitit.JobEnvironment.USR_SIG}"
                signal.raise_signal(signal.Signals[usual])  # submitit requeues it
            code = EXIT_CODE
        sys.exit(code)  # nobody waits for a result


def launch(plans: Sequence[Plan]) -> None:
    """Submit the incomplete seeds and wait; raises as `runner.run`, and Unattended."""
    commands = ("sbatch", "srun", "squeue")
    if missing := [name for name in commands if not shutil.which(name)]:
        why = f"there is no {', '.join(missing)} here: run it on a login node"
        raise ConfigError("hydra/launcher", "slurm", why)
    params = dict(plans[0].launcher or {})
    size, folder = params.pop("seeds_per_job", None), params["submitit_folder"]
    jobs: list[Plan] = []
    for plan in merged(plans):
        number = -(-len(plan.seeds) // size) if size else 1
        parts = [part(plan.seeds, f"{k}/{number}") for k in range(1, number + 1)]
        divided = [replace(plan, seeds=seeds) for seeds in parts]
        jobs += [each for each in divided if records.pending(each)]
    executor, arrays, stop = _executor(params), list[str](), Stop()
    began = time.monotonic()
    with stop.on_signals():
        for first in range(0, len(jobs), _ARRAY):
            some = jobs[first : first + _ARRAY]
            try:
                made = executor.map_array(_SlurmJob(), some, [sys.argv] * len(some))
            except (RuntimeError, OSError) as error:
                if stop.requested:  # Ctrl-C also ends a hanging sbatch
                    break
                raise _rejected(error, arrays, f"{first} of {len(jobs)}") from error
            arrays.append(made[0].job_id.partition("_")[0])
            say(f"Slurm: {len(some)} jobs as {arrays[-1]}; logs in {folder}")
            if stop.requested:
                break
        if arrays or stop.requested:
            _wait(arrays, plans[0].config["progress"] != "none", stop)
    runner.check_complete(plans, time.monotonic() - began)


def _executor(params: dict[str, Any]) -> submitit.AutoExecutor:
    """Submitit's executor with the parameters of the YAML."""
    del params["_target_"]
    folder, limit = params.pop("submitit_folder"), params.pop("max_num_timeout")
    executor = submitit.AutoExecutor(folder, "slurm", slurm_max_num_timeout=limit)
    # Since Slurm 22.05 each step has one core unless it asks for more.
    params["srun_args"] = [f"--cpus-per-task={params['cpus_per_task']}"]
    params["additional_parameters"] = {"requeue": True}  # also after a node's failure
    executor.update_parameters(**{f"slurm_{key}": params[key] for key in params})
    return executor


def _rejected(error: Exception, arrays: Sequence[str], taken: str) -> BcrlError:
    """The error to raise if sbatch fails, perhaps after it took some arrays."""
    words = " ".join(str(error).split())
    if not arrays:
        return BcrlError(f"Slurm rejects the jobs, none was submitted: {words}")
    names = " ".join(arrays)
    return Unattended(
        f"Slurm took {taken} jobs, as {names}, and rejects the rest: {words}\n"
        f"`scancel {names}` ends them; then run the same command again for the rest"
    )


def _wait(arrays: Sequence[str], telling: bool, stop: Stop) -> None:
    """Wait until no array has a job waiting or running; a signal interrupts."""
    pause, before, answered = 1.0, "", time.monotonic()
    while not stop.requested:
        listed, why = _squeue("--me", "--array", "--format=%F %T")
        now = f"squeue fails, trying again: {why}"
        if listed is not None:
            answered = time.monotonic()
            jobs = [line.split() for line in listed.splitlines()]
            states = Counter(state for array, state in jobs if array in arrays)
            if not states:
                return
            now = ", ".join(f"{n} {s.lower()}" for s, n in sorted(states.items()))
        elif time.monotonic() > answered + _PATIENCE:
            raise Unattended(f"{' '.join(arrays)} may still run; squeue fails: {why}")
        if now != before and (telling or why):
            say(f"Slurm: {now}")
        pause, before = 1.0 if now != before else min(30.0, 1.2 * pause), now
        time.sleep(pause)
    if arrays:
        say(f"bcrl: Slurm continues; `scancel {' '.join(arrays)}` ends the jobs")
    raise Interrupted


def _squeue(*options: str) -> tuple[str | None, str]:
    """Slurm's queue, or None and why squeue fails, as while Slurm restarts."""
    words = ["squeue", "--noheader", *options]
    try:
        done = subprocess.run(words, capture_output=True, timeout=60, errors="replace")
    except (OSError, subprocess.TimeoutExpired) as error:
        return None, str(error)
    if done.returncode:
        return None, f"exit code {done.returncode}, {' '.join(done.stderr.split())}"
    return done.stdout.strip(), ""
