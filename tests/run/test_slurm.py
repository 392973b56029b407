"""A sweep on Slurm: jobs warned, requeued and killed, arrays that Slurm rejects.

Without Slurm the tests on a real one are skipped; with BCRL_SLURM=1 they fail.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bcrl import cli
from bcrl.config.plan import Plan
from bcrl.run import launchers, runner
from tests.conftest import plans
from tests.run import cluster

SMALL = ("scale=smoke", "scale.max_iterations=20", "checkpoint_every=0.01", "tag=x")
SMALL += ("algorithm.regressor.trees=150",)  # a job takes seconds: time to disturb it
SWEEP = ("experiment=fig2", *SMALL)
PROGRAM = "import sys; from bcrl.cli import main; sys.argv[0] = 'bcrl'; main()"
LIMIT = 120.0  # seconds in which anything waited for must happen


# --- made-up commands instead of Slurm ---


@pytest.fixture
def made_up(tmp_path, monkeypatch):
    """Commands of Slurm's, of which sbatch takes so many arrays and rejects others."""

    def make(taken: int, squeue: str = "exit 0") -> None:
        commands = {
            "sbatch": f"echo >> calls; [ $(wc -l < calls) -le {taken} ] && "
            "{ echo Submitted batch job 4711; exit; }; echo QOSMaxSubmit >&2; exit 1",
            "squeue": squeue,
            "srun": "exit 0",
        }
        for name, text in commands.items():
            (tmp_path / name).write_text(f"#!/bin/bash\n{text}\n")
            (tmp_path / name).chmod(0o755)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr(launchers, "_ARRAY", 2)
    words = "-m env=maze variant=BC scale=smoke seeds.count=3 hydra/launcher=slurm"
    words += " hydra.launcher.seeds_per_job=1 progress=none"
    monkeypatch.setattr(sys, "argv", ["bcrl", *words.split()])
    return make


@pytest.mark.parametrize(("taken", "code"), [(0, 2), (1, 3)])
def test_the_arrays_before_a_rejected_one_are_named(made_up, taken, code, capsys):
    made_up(taken)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == code
    text = capsys.readouterr().err
    assert "QOSMaxSubmit" in text and ("scancel 4711" in text) == bool(taken)
    assert "HYDRA_FULL_ERROR" not in text


def test_without_slurm_its_launcher_is_rejected(made_up, monkeypatch, capsys):
    monkeypatch.setenv("PATH", "/nonexistent")
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    assert "hydra/launcher=slurm: there is no sbatch" in capsys.readouterr().err


def test_a_queue_that_never_answers_ends_the_waiting(made_up, monkeypatch):
    made_up(9, squeue="echo slurm_load_jobs error >&2; exit 1")
    monkeypatch.setattr(launchers, "_PATIENCE", 0.0)
    with pytest.raises(launchers.Unattended, match=r"slurm_load_jobs error.*4711"):
        launchers._wait(["4711"], True, launchers.Stop())
    assert launchers.Unattended.exit_code == 3


# --- a real Slurm ---


@pytest.fixture(scope="module")
def slurm():
    """The environment of a Slurm that is ready."""
    if missing := cluster.missing():
        text = f"{', '.join(missing)} not found: install slurmctld, slurmd and munge"
        assert os.environ.get("BCRL_SLURM") != "1", text
        pytest.skip(text)
    with cluster.running() as environment:
        yield environment


class Launched:
    """The command with Slurm's launcher, one seed a job; each plan has two seeds."""

    def __init__(
        self, environment: dict[str, str], folder: Path, *overrides: str
    ) -> None:
        self.environment = environment
        overrides += (f"runs_dir={folder}",)
        self.plans = plans(*overrides, multirun=True)
        command = [sys.executable, "-c", PROGRAM, "-m", *overrides]
        command += ["hydra/launcher=slurm", "hydra.launcher.seeds_per_job=1"]
        self.process = subprocess.Popen(
            command, env=environment, stderr=subprocess.PIPE, text=True
        )
        self.first = self.process.stderr.readline()  # "Slurm: 8 jobs as 1; …"
        self.array = self.first.partition(" as ")[2].partition(";")[0]

    def slurm(self, *command: str) -> str:
        done = subprocess.run(
            command, env=self.environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done
        return done.stdout.strip()

    def until(self, what: Callable[[], Any]) -> Any:
        """What `what` gives, once it is something."""
        end = time.monotonic() + LIMIT
        while not (found := what()):
            assert time.monotonic() < end, self.slurm("squeue")
            time.sleep(0.05)
        return found

    def begun(self, *but: int) -> int:
        """A job in the middle of its work that isn't one of these."""
        jobs = [job for job in range(2 * len(self.plans)) if job not in but]
        return self.until(lambda: next((j for j in jobs if self.checkpoints(j)), None))

    def checkpoints(self, job: int) -> list[Path]:
        plan, seed = self.plans[job // 2], job % 2
        return list(plan.directory.glob(f"checkpoint_{seed:04d}_*"))

    def about(self, job: int) -> dict[str, Any]:
        """What the JSON of a job's seed says."""
        directory = self.plans[job // 2].directory
        return json.loads((directory / f"seed_{job % 2:04d}.json").read_text())

    def name(self, job: int) -> str:
        return f"{self.array}_{job}"

    def warn(self, job: int) -> None:
        """SIGUSR2 to a job, once: scancel would go on until its process is there."""
        command = ["scancel", "--signal=USR2", self.name(job)]
        with subprocess.Popen(command, env=self.environment) as scancel:
            one = ("squeue", "--noheader", f"--jobs={self.name(job)}", "--format=%T")
            self.until(lambda: self.slurm(*one) != "RUNNING")
            scancel.kill()

    def restarts(self, job: int) -> int:
        about = self.slurm("scontrol", "show", "job", self.name(job))
        return int(about.partition("Restarts=")[2].split()[0])

    def end(self) -> tuple[int, str]:
        """The exit code, and what was said."""
        _, said = self.process.communicate(timeout=LIMIT)
        return self.process.returncode, self.first + said


def written(plans: list[Plan]) -> list[dict[str, bytes]]:
    """The results of plans, but what tells of machine and time."""
    return [
        {
            file.name: file.read_bytes()
            for file in plan.directory.iterdir()
            if file.suffix != ".json"
        }
        for plan in plans
    ]


@pytest.mark.slow
@pytest.mark.slurm
def test_a_sweep_whose_jobs_are_disturbed_ends_in_equal_files(slurm, tmp_path):
    sweep = Launched(slurm, tmp_path / "here", *SWEEP)
    warned = sweep.begun()
    sweep.warn(warned)  # as before a time limit
    failed = sweep.begun(warned)
    sweep.slurm("scontrol", "requeue", sweep.name(failed))  # as where a node fails
    killed = sweep.begun(warned, failed)
    os.kill(sweep.about(killed)["pid"], signal.SIGKILL)

    code, said = sweep.end()
    assert code == 1 and "1 seed failed" in said, said
    assert "begun, but its process died" in said and "Traceback" not in said
    assert [sweep.restarts(job) for job in (warned, failed, killed)] == [1, 1, 0]
    for job in (warned, failed):
        about = sweep.about(job)
        assert about["status"] == "complete" and about["interruptions"] >= 1, about
        assert about["command"].startswith("bcrl -m experiment=fig2")
        assert about["asked"] == [[0, 1]]  # though it was a job of one seed
    assert sweep.about(killed)["status"] == "running" and sweep.checkpoints(killed)

    again = Launched(slurm, tmp_path / "here", *SWEEP)
    calm = plans(*SWEEP, f"runs_dir={tmp_path / 'calm'}", multirun=True)
    runner.run(*calm)
    code, said = again.end()
    assert code == 0 and said.startswith("Slurm: 1 job "), said
    assert [len(files) for files in written(calm)] == [1 + 2 * 2] * 4
    assert written(again.plans) == written(calm)


@pytest.mark.slow
@pytest.mark.slurm
def test_slurm_continues_without_the_command_until_scancel(slurm, tmp_path):
    long = (*SMALL[:-1], "algorithm.regressor.trees=2000")  # until it is cancelled
    sweep = Launched(slurm, tmp_path, "env=maze", "variant=BC", *long)
    sweep.process.terminate()
    code, said = sweep.end()
    assert code == 75 and f"scancel {sweep.array}" in said, said
    job = sweep.begun()
    sweep.slurm("scancel", sweep.array)
    sweep.until(lambda: not sweep.slurm("squeue", "--noheader"))
    assert sweep.restarts(job) == 0
    assert sweep.about(job)["status"] == "running" and sweep.checkpoints(job)
