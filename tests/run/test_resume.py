"""Runs that are killed, asked to stop, raced or robbed end as if nothing had been.

BCRL_KILLS=12 kills each of all variants so often (default: one each of a few).
"""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from bcrl.common.files import is_intact
from bcrl.errors import BcrlError
from bcrl.run import checkpoints, runner
from tests.conftest import plan
from tests.run import killing
from tests.run.test_runs import digest

KILLS = int(os.environ.get("BCRL_KILLS", "0"))
FEW = ("maze C", "car_on_hill BC", "dqn C", "dqn SBC")
ROOT = Path(__file__).parents[2]


def kill(folder: Path, *names: str) -> list[dict]:
    """What `tests.killing` finds."""
    arguments = [str(folder), "1", str(max(1, KILLS)), *names]
    done = subprocess.run(
        [sys.executable, "-m", "tests.killing", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.parametrize("name", killing.RUNS if KILLS else FEW)
def test_a_run_killed_at_any_moment_goes_on_to_the_same_bytes(tmp_path, name):
    (found,) = kill(tmp_path, name)
    assert found["problem"] is None, found
    assert found["kills"] >= max(1, KILLS)


@pytest.mark.parametrize("processes", [2, 8])
def test_each_seed_is_computed_once_by_racing_processes(tmp_path, processes):
    (found,) = kill(tmp_path, f"race of {processes}")
    assert found["problem"] is None, found
    assert found["computed"] == list(range(6))


def test_the_lock_file_of_a_dead_process_is_no_lock(tmp_path):
    (found,) = kill(tmp_path, "stale lock")
    assert found["problem"] is None, found


# --- signals ---

LONG = ("env=maze", "curriculum=on", "boosting=on", "tag=x", "seeds.count=2")
LONG += ("seeds.lockstep=1", "algorithm.iterations=10", "threads=1")


def start(folder: Path, *more: str) -> subprocess.Popen:
    """The command, once it has begun to train."""
    program = (
        "import signal, sys; from bcrl.cli import main; sys.argv[0] = 'bcrl';"
        # A shell's background jobs, and so perhaps this test, ignore it from the start.
        "signal.signal(signal.SIGINT, signal.default_int_handler); main()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program, *LONG, f"runs_dir={folder}", *more],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    process.stderr.readline()
    return process


@pytest.fixture(scope="module")
def calm(tmp_path_factory):
    """The run that nobody disturbs."""
    p = plan(*LONG, "progress=none", f"runs_dir={tmp_path_factory.mktemp('calm')}")
    runner.run(p)
    return p


@pytest.mark.parametrize(
    ("number", "workers"),
    [
        (signal.SIGTERM, 1),
        (signal.SIGINT, 2),
        (signal.SIGUSR1, 2),
        (signal.SIGUSR2, 1),
    ],
)
def test_a_signal_saves_and_leaves_with_75(tmp_path, calm, number, workers):
    process = start(tmp_path, f"workers={workers}")
    os.killpg(process.pid, number) if workers == 2 else process.send_signal(number)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 75, said
    assert "run the same command again" in said and "Traceback" not in said
    p = plan(*LONG, "progress=none", f"runs_dir={tmp_path}")
    assert list(p.directory.glob("checkpoint_*.npz"))
    assert not list(p.directory.glob(".*"))  # neither locks nor half a file
    begun = json.loads((p.directory / "seed_0000.json").read_text())
    assert begun["status"] == "running" and is_intact(begun)
    runner.run(p)
    for seed in (0, 1):
        assert digest(p, seed) == digest(calm, seed)
        about = json.loads((p.directory / f"seed_{seed:04d}.json").read_text())
        assert about["status"] == "complete"
    assert killing.compared(calm, p) is None


def test_a_second_signal_ends_it_at_once(tmp_path):
    process = start(tmp_path)
    process.send_signal(signal.SIGTERM)
    time.sleep(0.002)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=60) in (75, -signal.SIGTERM)
    process.stderr.close()


def test_workers_whose_parent_is_killed_save_and_leave(tmp_path, calm):
    process = start(tmp_path, "workers=2")
    process.kill()
    process.wait()
    process.stderr.close()
    p = plan(*LONG, "progress=none", f"runs_dir={tmp_path}")
    runner.run(p)  # waits for them, if need be
    assert killing.compared(calm, p) is None


def children(pid: int) -> list[int]:
    """A process's children that train (the other one only keeps count)."""
    listed = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    trains = "spawn_main"
    return [int(c) for c in listed if trains in Path(f"/proc/{c}/cmdline").read_text()]


def test_a_worker_that_dies_fails_its_job_alone(tmp_path, calm):
    process = start(tmp_path, "workers=2")
    os.kill(children(process.pid)[0], signal.SIGKILL)
    _, said = process.communicate(timeout=120)
    assert process.returncode == 1, said
    assert "1 seed failed" in said and "killed (out of memory?" in said
    command = said.split("to run just this again:\n  ")[1].splitlines()[0]
    assert command.startswith("bcrl env=maze curriculum=on")
    p = plan(*LONG, "progress=none", f"runs_dir={tmp_path}")
    left = runner.records.pending(p)
    assert len(left) == 1
    runner.run(p)
    assert killing.compared(calm, p) is None


def test_a_worker_that_alone_is_told_to_stop_is_replaced(tmp_path, calm):
    process = start(tmp_path, "workers=2", "seeds.count=2")
    os.kill(children(process.pid)[0], signal.SIGTERM)
    _, said = process.communicate(timeout=120)
    assert process.returncode == 0, said
    p = plan(*LONG, "progress=none", f"runs_dir={tmp_path}")
    assert killing.compared(calm, p) is None


@pytest.mark.parametrize("workers", [1, 2])
def test_nobody_reading_what_is_said_is_no_failure(tmp_path, calm, workers):
    process = start(tmp_path, f"workers={workers}", "progress=lines")
    process.stderr.close()
    assert process.wait(timeout=120) in (0, 120)  # 120: Python can't flush its stream
    p = plan(*LONG, "progress=none", f"runs_dir={tmp_path}")
    assert killing.compared(calm, p) is None


# --- what a checkpoint may be ---


def interrupted(folder: Path, *more: str):
    """A plan with a checkpoint in its folder, and that file."""
    p = plan("env=maze", "variant=BC", "scale=smoke", "progress=none", *more)
    p = plan(*p.command.split()[1:], f"runs_dir={folder}")

    class Enough(Exception):
        pass

    def save(*arguments):
        real(*arguments)
        raise Enough

    real, checkpoints.save = checkpoints.save, save
    try:
        with pytest.raises(runner.SeedsFailed, match="Enough"):
            runner.run(p)
    finally:
        checkpoints.save = real
    (path,) = p.directory.glob("checkpoint_*.npz")
    return p, path


def test_a_checkpoint_that_is_none_is_refused_by_name(tmp_path):
    import pickle

    class Evil:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'canary'}",)

    p, path = interrupted(tmp_path)
    good = path.read_bytes()
    for bad in (pickle.dumps(Evil()), good[: len(good) // 2], b"", good[:-60]):
        path.write_bytes(bad)
        with pytest.raises(BcrlError, match=f"{path.name} can't be read.*remove it"):
            runner.run(p)
    flipped = bytearray(good)
    flipped[len(good) // 2] ^= 1
    path.write_bytes(flipped)
    with pytest.raises(BcrlError, match=f"{path.name} can't be read.*remove it"):
        runner.run(p)
    assert not (tmp_path / "canary").exists()
    path.unlink()
    runner.run(p)
    assert not runner.records.pending(p)


def test_a_checkpoint_of_other_code_counts_as_absent(tmp_path, monkeypatch):
    p, path = interrupted(tmp_path / "a")
    before = path.stat().st_mtime_ns
    monkeypatch.setattr(checkpoints, "_code", lambda: "another")
    assert checkpoints.teams(p) == {} and path.stat().st_mtime_ns == before
    runner.run(p)  # from the start
    other, _ = interrupted(tmp_path / "b")
    runner.run(other)
    assert killing.compared(p, other) is None  # and the old one is gone


def test_a_checkpoint_of_other_code_of_the_users_counts_as_absent(tmp_path):
    made = plan("env=maze", "scale=smoke", f"runs_dir={tmp_path}")
    one, other = (checkpoints._about(replace(made, sources=x)) for x in ("", "code"))
    assert one != other


def test_other_seeds_than_a_checkpoints_start_by_themselves(tmp_path):
    p, path = interrupted(tmp_path, "seeds.count=3")
    one = plan(*p.command.split()[1:], "seeds.count=1")
    runner.run(one)
    assert path.exists()  # of use to whoever asks for all three
    done = (p.directory / "seed_0000.csv").stat().st_mtime_ns
    runner.run(p)
    assert (p.directory / "seed_0000.csv").stat().st_mtime_ns == done
    assert not path.exists() and not runner.records.pending(p)


def test_a_file_that_changes_under_a_run_is_not_the_code_that_runs(
    tmp_path, monkeypatch
):
    checkpoints._code.cache_clear()
    before = checkpoints._code()
    (tmp_path / "other.py").write_text("A = 1")
    monkeypatch.setattr(checkpoints, "__file__", str(tmp_path / "checkpoints.py"))
    assert checkpoints._ours() != checkpoints.OURS  # what is on disk now
    checkpoints._code.cache_clear()
    assert checkpoints._code() == before
