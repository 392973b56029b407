"""A sweep on Slurm: jobs warned, requeued and killed, arrays that Slurm rejects.

Without Slurm the tests on a real one are skipped; with BCRL_SLURM=1 they fail.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bcrl import cli
from bcrl.run import launchers, runner
from tests.conftest import plans
from tests.run import cluster
from tests.run.runs import about, compared

SMALL = ("scale=smoke", "scale.max_iterations=20", "checkpoint_every=0.01", "tag=x")
SMALL += ("algorithm.regressor.trees=150",)  # a job takes seconds: time to disturb it
SWEEP = ("experiment=fig2", *SMALL)
PROGRAM = "import sys; from bcrl.cli import main; sys.argv[0] = 'bcrl'; main()"
LIMIT = 120.0  # seconds in which anything waited for must happen

REJECTS = {
    "sbatch": "echo >> calls; [ $(wc -l < calls) -le {taken} ] && "
    "{{ echo Submitted batch job 4711; exit; }}; echo QOSMaxSubmit >&2; exit 1",
    "squeue": "echo slurm_load_jobs error >&2; exit 1",
    "srun": "exit 0",
}
THREE = "-m env=maze variant=BC scale=smoke seeds.count=3 hydra/launcher=slurm"
THREE += " hydra.launcher.seeds_per_job=1 progress=none"

#: How many of two arrays sbatch takes → the exit code, and parts of the message.
REJECTED = {
    None: (2, "hydra/launcher=slurm: there is no sbatch"),
    0: (2, "none was submitted.*QOSMaxSubmit"),
    1: (3, "QOSMaxSubmit.*scancel 4711"),
    2: (3, "4711 may still run.*slurm_load_jobs error"),
}


@pytest.mark.parametrize("taken", REJECTED)
def test_jobs_that_slurm_rejects_end_the_command(tmp_path, monkeypatch, taken, capsys):
    there = {} if taken is None else REJECTS
    for name, text in there.items():
        (tmp_path / name).write_text(f"#!/bin/bash\n{text.format(taken=taken)}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin" if there else "/nowhere")
    monkeypatch.setattr(launchers, "_ARRAY", 2)
    monkeypatch.setattr(launchers, "_PATIENCE", 0.0)
    monkeypatch.setattr(sys, "argv", ["bcrl", *THREE.split()])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    code, words = REJECTED[taken]
    assert ended.value.code == code
    assert re.search(words, capsys.readouterr().err, re.S)


@pytest.fixture(scope="module")
def slurm():
    """The environment of a Slurm that is ready."""
    programs = ("munged", "slurmctld", "slurmd", "sbatch")
    if missing := [x for x in programs if not shutil.which(x, path=cluster.SBIN)]:
        text = f"{', '.join(missing)} not found: install slurmctld, slurmd and munge"
        assert os.environ.get("BCRL_SLURM") != "1", text
        pytest.skip(text)
    with cluster.running() as environment:
        yield environment


class Launched:
    """The command with Slurm's launcher, one seed per job; each plan has two seeds."""

    def __init__(self, slurm: dict[str, str], folder: Path, *overrides: str) -> None:
        self.environment = slurm
        overrides += (f"runs_dir={folder}",)
        self.plans = plans(*overrides, multirun=True)
        command = [sys.executable, "-c", PROGRAM, "-m", *overrides]
        command += ["hydra/launcher=slurm", "hydra.launcher.seeds_per_job=1"]
        streams = {"stderr": subprocess.PIPE, "text": True}
        self.process = subprocess.Popen(command, env=slurm, **streams)
        self.first = self.process.stderr.readline()  # "Slurm: 8 jobs as 1; …"
        self.array = self.first.partition(" as ")[2].partition(";")[0]

    def slurm(self, *command: str) -> str:
        return subprocess.check_output(command, env=self.environment, text=True).strip()

    def until(self, what: Callable[[], Any]) -> Any:
        """The result of `what`, once it is something."""
        end = time.monotonic() + LIMIT
        while not (found := what()):
            assert time.monotonic() < end, self.slurm("squeue")
            time.sleep(0.05)
        return found

    def begun(self, *but: int) -> int:
        """A job, none of these, at its start: one that began may be about to end."""
        jobs = [job for job in range(2 * len(self.plans)) if job not in but]
        jobs = [job for job in jobs if not self.checkpoints(job)]
        return self.until(lambda: next((j for j in jobs if self.checkpoints(j)), None))

    def checkpoints(self, job: int) -> list[Path]:
        return list(self.plans[job // 2].directory.glob(f"checkpoint_000{job % 2}_*"))

    def about(self, job: int) -> dict[str, Any]:
        return about(self.plans[job // 2], job % 2)

    def warn(self, job: int) -> None:
        """SIGUSR2 to a job, once: scancel would continue until its process exists."""
        name = f"{self.array}_{job}"
        command = ["scancel", "--signal=USR2", name]
        with subprocess.Popen(command, env=self.environment) as scancel:
            one = ("squeue", "--noheader", f"--jobs={name}", "--format=%T")
            self.until(lambda: self.slurm(*one) != "RUNNING")
            scancel.kill()

    def restarts(self, job: int) -> int:
        shown = self.slurm("scontrol", "show", "job", f"{self.array}_{job}")
        return int(shown.partition("Restarts=")[2].split()[0])

    def end(self) -> tuple[int, str]:
        """The exit code and the messages."""
        _, text = self.process.communicate(timeout=LIMIT)
        return self.process.returncode, self.first + text


@pytest.mark.slow
@pytest.mark.slurm
def test_a_sweep_whose_jobs_are_disturbed_ends_in_equal_files(slurm, tmp_path):
    sweep = Launched(slurm, tmp_path / "here", *SWEEP)
    warned = sweep.begun()
    sweep.warn(warned)  # as before a time limit
    failed = sweep.begun(warned)  # as where a node fails:
    sweep.slurm("scontrol", "requeue", f"{sweep.array}_{failed}")
    killed = sweep.begun(warned, failed)
    os.kill(sweep.about(killed)["pid"], signal.SIGKILL)

    code, text = sweep.end()
    assert code == 1 and "1 seed failed" in text, text
    assert ": interrupted" in text and "Traceback" not in text
    assert [sweep.restarts(job) for job in (warned, failed, killed)] == [1, 1, 0]
    for job in (warned, failed):
        facts = sweep.about(job)
        assert facts["status"] == "complete" and facts["interruptions"] >= 1, facts
        assert facts["command"].startswith("bcrl -m experiment=fig2")
        assert facts["asked"] == [[0, 1]]  # though it was a job of one seed
    assert sweep.about(killed)["status"] == "running" and sweep.checkpoints(killed)

    again = Launched(slurm, tmp_path / "here", *SWEEP)
    calm = plans(*SWEEP, f"runs_dir={tmp_path / 'calm'}", multirun=True)
    runner.run(*calm)
    code, text = again.end()
    assert code == 0 and text.startswith("Slurm: 1 jobs "), text
    assert {compared(*pair) for pair in zip(calm, again.plans, strict=True)} == {None}


@pytest.mark.slow
@pytest.mark.slurm
def test_slurm_continues_without_the_command_until_scancel(slurm, tmp_path):
    long = (*SMALL[:-1], "algorithm.regressor.trees=2000")  # until it is cancelled
    sweep = Launched(slurm, tmp_path, "env=maze", "variant=BC", *long)
    sweep.process.terminate()
    code, text = sweep.end()
    assert code == 75 and f"scancel {sweep.array}" in text, text
    job = sweep.begun()
    sweep.slurm("scancel", sweep.array)
    sweep.until(lambda: not sweep.slurm("squeue", "--noheader"))
    assert sweep.restarts(job) == 0
    assert sweep.about(job)["status"] == "running" and sweep.checkpoints(job)
