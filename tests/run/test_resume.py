"""Runs that are interrupted, killed or raced end as if nothing had happened.

The fast tests stop runs within this process. The slow ones send real signals and kill
real processes; BCRL_KILLS=12 kills each of all variants so often (default: one each of
a few).
"""

import itertools
import json
import os
import pickle
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from bcrl.common.files import is_intact
from bcrl.common.signals import Interrupted, Stop
from bcrl.errors import BcrlError
from bcrl.run import checkpoints, locks, runner
from bcrl.run.records import pending
from tests.conftest import plan
from tests.run import killing
from tests.run.runs import MAZE, about, compared, dqn, run

KILLS = int(os.environ.get("BCRL_KILLS", "0"))
FEW = ("maze C", "car_on_hill BC", "dqn C", "dqn SBC")
ROOT = Path(__file__).parents[2]


class Countdown(Stop):
    """Requests a stop when it is checked for the `left`-th time."""

    left = 0

    @property
    def requested(self) -> bool:
        self.left -= 1
        return self.left <= 0

    @requested.setter
    def requested(self, value: bool) -> None:
        pass


@pytest.mark.parametrize(
    ("choice", "steps"), [(MAZE, 5), (dqn("C"), 330), (dqn("SBC"), 180)]
)
def test_a_run_that_stops_again_and_again_ends_in_equal_files(
    tmp_path, monkeypatch, choice, steps
):
    calm = run(tmp_path / "calm", *choice)
    p = plan(*choice, f"runs_dir={tmp_path}/here", "checkpoint_every=1e9")
    monkeypatch.setattr(runner, "Stop", Countdown)
    monkeypatch.setattr(Countdown, "left", steps)
    stops = 0
    while pending(p):
        try:
            runner.run(p)
        except Interrupted:
            stops += 1
            assert list(p.directory.glob("checkpoint_*.npz"))
            assert not list(p.directory.glob(".*"))  # neither locks nor half a file
            assert about(p, 0)["status"] == "running" and is_intact(about(p, 0))
    assert stops >= 3 and about(p, 0)["interruptions"] == stops
    assert compared(calm, p) is None


# --- what a checkpoint may be ---


@pytest.fixture
def interrupted(monkeypatch):
    """Makes a plan with a checkpoint in its folder, and that file."""

    def make(folder: Path, *more: str):
        p = plan(*MAZE, *more, f"runs_dir={folder}", "checkpoint_every=1e9")
        with monkeypatch.context() as patched:
            patched.setattr(runner, "Stop", Countdown)
            patched.setattr(Countdown, "left", 6)
            with pytest.raises(Interrupted):
                runner.run(p)
        (path,) = p.directory.glob("checkpoint_*.npz")
        return p, path

    return make


def test_a_damaged_checkpoint_is_rejected_by_name(tmp_path, interrupted):
    class Evil:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'canary'}",)

    p, path = interrupted(tmp_path)
    good = path.read_bytes()
    flipped = bytearray(good)
    flipped[len(good) // 2] ^= 1
    half = good[: len(good) // 2]
    for bad in (pickle.dumps(Evil()), half, b"", good[:-60], bytes(flipped)):
        path.write_bytes(bad)
        with pytest.raises(BcrlError, match=f"{path.name} can't be read.*remove it"):
            runner.run(p)
    assert not (tmp_path / "canary").exists()
    path.unlink()
    runner.run(p)
    assert pending(p) == []


def test_a_checkpoint_of_other_code_counts_as_absent(
    tmp_path, monkeypatch, interrupted
):
    p, path = interrupted(tmp_path / "a")
    before = path.read_bytes()
    monkeypatch.setattr(checkpoints, "_code", lambda: "another")
    assert not checkpoints.batches(p) and path.read_bytes() == before
    runner.run(p)  # from the start
    assert about(p, 0)["interruptions"] == 0 and not path.exists()


def test_a_checkpoint_names_our_code_and_the_users(tmp_path, monkeypatch):
    made = plan("env=maze", "scale=smoke", f"runs_dir={tmp_path}")
    about = [checkpoints._about(replace(made, sources=x)) for x in ("", "A", "B")]
    monkeypatch.setattr(checkpoints, "_OURS", [b"other sources of ours"])
    checkpoints._code.cache_clear()
    about.append(checkpoints._about(made))
    checkpoints._code.cache_clear()
    assert all(one != other for one, other in itertools.combinations(about, 2))


def test_other_seeds_than_a_checkpoints_start_by_themselves(tmp_path, interrupted):
    p, path = interrupted(tmp_path, "seeds.count=3")
    one = run(tmp_path, *MAZE, "seeds.count=1")
    assert path.exists()  # of use to a command for all three seeds
    done = (one.directory / "seed_0000.csv").stat().st_mtime_ns
    runner.run(p)
    assert (p.directory / "seed_0000.csv").stat().st_mtime_ns == done
    assert not path.exists() and pending(p) == []


# --- locks ---


def test_a_seed_has_one_holder_who_is_named_and_whose_death_frees_it(tmp_path):
    lock, other = (locks.seed_lock(tmp_path, 7) for _ in range(2))
    assert lock.acquire() and lock.holds() and not other.acquire()
    assert other.holder() == lock.holder() and str(os.getpid()) in lock.holder()
    assert locks.is_held(tmp_path, 7) and not locks.is_held(tmp_path, 8)
    lock.release()
    assert list(tmp_path.iterdir()) == [] and not locks.is_held(tmp_path, 7)
    lock.path.write_text("process 1 on elsewhere")  # of a process that died
    (tmp_path / ".seed_0007.csv.1.tmp").touch()
    (tmp_path / ".checkpoint_0007_ab.npz.1.tmp").touch()
    assert not locks.is_held(tmp_path, 7)
    locks.tidy(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_lock_of_a_folder_that_was_replaced_holds_no_more(tmp_path):
    lock = locks.seed_lock(tmp_path, 7)
    assert lock.acquire()
    lock.path.rename(tmp_path / "moved")
    assert not lock.holds()
    lock.path.touch()
    assert not lock.holds()
    lock.release()
    assert lock.path.exists()  # it may be another process's


@pytest.mark.parametrize("code", ["ENOLCK", "ENOSYS", "EOPNOTSUPP", "EIO"])
def test_a_file_system_without_locks_is_rejected(tmp_path, monkeypatch, code):
    def flock(*_):
        raise OSError(getattr(locks.errno, code), "words of the system")

    monkeypatch.setattr(locks.fcntl, "flock", flock)
    with pytest.raises(BcrlError, match=f"runs_dir: .*{tmp_path}.*words of the system"):
        locks.seed_lock(tmp_path, 7).acquire()


# --- real processes ---


def kill(folder: Path, *names: str) -> list[dict]:
    """What `tests.run.killing` finds."""
    arguments = [str(folder), "1", str(max(1, KILLS)), *names]
    command = [sys.executable, "-m", "tests.run.killing", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.slow
@pytest.mark.parametrize("name", killing.RUNS if KILLS else FEW)
def test_a_run_killed_at_any_moment_resumes_and_ends_in_equal_files(tmp_path, name):
    (found,) = kill(tmp_path, name)
    assert found["problem"] is None, found
    assert found["kills"] >= max(1, KILLS)


@pytest.mark.slow
@pytest.mark.parametrize("processes", [2, 8])
def test_each_seed_is_computed_once_by_racing_processes(tmp_path, processes):
    (found,) = kill(tmp_path, f"race of {processes}")
    assert found["problem"] is None, found
    assert found["computed"] == list(range(6))


LONG = ("env=maze", "curriculum=on", "boosting=on", "tag=x", "seeds.count=2")
LONG += ("seeds.lockstep=1", "algorithm.iterations=40", "threads=1")


def start(folder: Path, *more: str) -> subprocess.Popen:
    """The command, once it has begun to train."""
    program = (
        "import signal, sys; from bcrl.cli import main; sys.argv[0] = 'bcrl';"
        # A shell's background jobs, and so perhaps this test, ignore it from the start.
        "signal.signal(signal.SIGINT, signal.default_int_handler); main()"
    )
    command = [sys.executable, "-c", program, *LONG, f"runs_dir={folder}", *more]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    process.stderr.readline()
    return process


@pytest.fixture(scope="module")
def calm(tmp_path_factory):
    """The run without a disturbance."""
    return run(tmp_path_factory.mktemp("calm"), *LONG, "progress=none")


def resumed(folder: Path):
    """The plan of LONG, after a run that resumes it."""
    return run(folder, *LONG, "progress=none")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "workers"),
    [(signal.SIGTERM, 1), (signal.SIGINT, 2), (signal.SIGUSR1, 2), (signal.SIGHUP, 1)],
)
def test_a_signal_saves_and_leaves_with_75(tmp_path, calm, number, workers):
    process = start(tmp_path, f"workers={workers}")
    os.killpg(process.pid, number) if workers == 2 else process.send_signal(number)
    _, text = process.communicate(timeout=120)
    assert process.returncode == 75, text
    assert "run the same command again" in text and "Traceback" not in text
    p = plan(*LONG, "progress=none", f"runs_dir={tmp_path}")
    assert list(p.directory.glob("checkpoint_*.npz"))
    assert not list(p.directory.glob(".*"))  # neither locks nor half a file
    assert about(p, 0)["status"] == "running" and is_intact(about(p, 0))
    assert compared(calm, resumed(tmp_path)) is None


@pytest.mark.slow
def test_a_second_signal_ends_it_at_once(tmp_path):
    process = start(tmp_path)
    process.send_signal(signal.SIGTERM)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=120) in (75, -signal.SIGTERM)
    process.stderr.close()


def children(pid: int) -> list[int]:
    """A process's children that train."""
    listed = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    trains = "spawn_main"
    return [int(c) for c in listed if trains in Path(f"/proc/{c}/cmdline").read_text()]


@pytest.mark.slow
def test_workers_whose_parent_is_killed_save_and_leave(tmp_path, calm):
    process = start(tmp_path, "workers=2")
    process.kill()
    process.wait()
    process.stderr.close()
    assert compared(calm, resumed(tmp_path)) is None  # waits for them, if need be


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_worker_that_dies_fails_its_job_alone(tmp_path, calm, number):
    """Of other signals a worker takes no notice: they are for its parent."""
    process = start(tmp_path, "workers=2")
    os.kill(children(process.pid)[0], number)
    _, text = process.communicate(timeout=180)
    if number == signal.SIGKILL:
        assert process.returncode == 1, text
        assert "1 seed failed" in text and "killed (out of memory?" in text
        command = text.split("to run just this again:\n  ")[1].splitlines()[0]
        assert command.startswith("bcrl env=maze curriculum=on")
        assert len(pending(plan(*LONG, f"runs_dir={tmp_path}"))) == 1
    else:
        assert process.returncode == 0, text
    assert compared(calm, resumed(tmp_path)) is None


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_a_closed_terminal_is_no_failure(tmp_path, calm, workers):
    process = start(tmp_path, f"workers={workers}", "progress=lines")
    process.stderr.close()
    assert process.wait(timeout=180) in (0, 120)  # 120: Python can't flush its stream
    p = plan(*LONG, "progress=none", f"runs_dir={tmp_path}")
    assert compared(calm, p) is None
