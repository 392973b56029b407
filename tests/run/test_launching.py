"""Hydra's joblib launcher gives the same bytes, codes and words as no launcher."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bcrl.config import plan as compose
from bcrl.errors import BcrlError
from bcrl.run import runner
from bcrl.run.workers import cores
from tests.conftest import plan, plans

LOCAL = ("hydra/launcher=local", "hydra.launcher.seeds_per_job=1")
SMALL = ("env=maze", "variant=plain,BC", "scale=smoke", "tag=t", "progress=none")
SMALL += ("algorithm/regressor=tabular",)
MAZE = "env=maze"


def written(folder: Path) -> dict[str, bytes]:
    """Everything of the results but what tells of machine and time."""
    files = [f for f in folder.rglob("*.*") if f.suffix in (".csv", ".npz", ".yaml")]
    kept = [f for f in files if ".sweep" not in f.parts]
    return {str(f.relative_to(folder)): f.read_bytes() for f in kept}


def calm(folder: Path, *overrides: str) -> dict[str, bytes]:
    """What the same command writes without a launcher."""
    runner.run(*plans(*overrides, f"runs_dir={folder}", multirun=True))
    return written(folder)


def test_processes_write_what_one_does_and_only_what_is_missing(bcrl, tmp_path):
    done = bcrl("-m", *SMALL, *LOCAL, "runs_dir='it,is=here'")
    assert done.returncode == 0, done.stderr
    assert written(tmp_path / "it,is=here") == calm(tmp_path / "calm", *SMALL)
    for file in (tmp_path / "it,is=here").rglob("seed_*.json"):
        about = json.loads(file.read_text())
        assert about["config"]["threads"] == max(1, cores() // min(cores(), 4))
        assert about["lockstep"] == [about["seed"]]  # a job of one seed …
        assert about["asked"] == [[0, 1]]  # … of two that were asked for
        assert "hydra/launcher=local" in about["command"]
    lost = tmp_path / "it,is=here/smoke/maze/FQI@t/seed_0001.json"
    lost.unlink()
    began = time.time()
    done = bcrl("-m", *SMALL, *LOCAL, "runs_dir='it,is=here'")
    assert done.returncode == 0 and lost.exists(), done.stderr
    found = list(lost.parents[1].rglob("seed_*.json"))
    assert len(found) == 4
    assert [f for f in found if f.stat().st_mtime > began] == [lost]


def test_a_job_that_fails_is_told_in_the_end_and_the_others_are_complete(
    bcrl, tmp_path
):
    folder = tmp_path / "runs/smoke/maze/FQI@t"
    folder.mkdir(parents=True)
    (folder / "checkpoint_0000_00000000.npz").write_text("no checkpoint")
    done = bcrl("-m", *SMALL, *LOCAL)
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    assert "checkpoint_0000_00000000.npz" in done.stderr
    last = done.stderr[done.stderr.rindex("bcrl: 2 seeds failed") :]
    assert "maze FQI@t, seeds 0–1: never begun" in last and "BC-FQI" not in last
    assert "  bcrl -m env=maze variant=plain " in last
    assert "hydra/launcher=local" in last
    assert len(list(tmp_path.glob("runs/smoke/maze/BC-FQI@t/seed_*.csv"))) == 2


def test_a_signal_to_the_command_has_all_its_processes_save(tmp_path):
    long = (MAZE, "variant=plain,BC", "tag=x", "scale=smoke", "scale.max_iterations=16")
    long += ("checkpoint_every=0.01", "threads=1", "progress=none")
    program = "import sys; sys.argv[0] = 'bcrl'; from bcrl.cli import main; main()"
    command = [sys.executable, "-c", program, "-m", *long, *LOCAL]
    command += [f"runs_dir={tmp_path / 'here'}", "hydra.launcher.n_jobs=2"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    end = time.monotonic() + 60
    while len(list(tmp_path.rglob("checkpoint_*"))) < 1:
        assert time.monotonic() < end and process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 75 and "Traceback" not in said, said
    assert "run the same command again" in said
    begun = [json.loads(f.read_text()) for f in tmp_path.rglob("seed_*.json")]
    assert "running" in {about["status"] for about in begun}
    assert len(begun) < 4  # what waited has not been begun
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert written(tmp_path / "here") == calm(tmp_path / "calm", *long)


def test_the_parts_of_seeds_are_all_of_them_once():
    for count in (1, 2, 7, 20):
        for parts in range(1, count + 1):
            each = [
                compose.part(tuple(range(count)), f"{k}/{parts}")
                for k in range(1, parts + 1)
            ]
            assert sum(each, ()) == tuple(range(count)) and all(each)
    second = plan(MAZE, "seeds.first=10", "seeds.count=5", "seeds.part=2/2")
    assert second.seeds == (12, 13, 14) and second.asked == tuple(range(10, 15))
    assert second.directory == plan(MAZE).directory
    whole = plans(MAZE, "seeds.count=5", "seeds.part=1/2,2/2", multirun=True)
    assert [p.seeds for p in runner.merged(whole)] == [(0, 1, 2, 3, 4)]


@pytest.mark.parametrize("part", ["0/2", "3/2", "1/4", "1", "a/b", "1/0", "-1/2"])
def test_a_part_that_is_none_is_refused(part):
    with pytest.raises(BcrlError, match=r"seeds\.part"):
        plan(MAZE, "seeds.count=3", f"seeds.part={part}")


def test_cores_are_those_that_slurm_has_given(monkeypatch):
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "1")
    assert cores() == 1
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "4096")
    assert cores() == len(os.sched_getaffinity(0))
