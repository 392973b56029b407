"""Runs that are interrupted, killed or raced end as if nothing had happened.

The slow tests send real signals and kill real processes; BCRL_KILLS=12 kills each of
all variants so often (default: three each of a few).
"""

import errno
import importlib
import json
import os
import pickle
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from bcrl.common.files import is_intact
from bcrl.common.signals import Interrupted, Stop
from bcrl.config.plan import Plan
from bcrl.errors import BcrlError
from bcrl.run import checkpoints, locks, runner
from bcrl.run.records import pending
from tests.conftest import plan
from tests.run.runs import KINDS, MAZE, TABULAR, about, at_row, compared, run

KILLS = int(os.environ.get("BCRL_KILLS", "0"))
FEW = ("maze C", "car_on_hill C", "dqn C", "dqn SBC", "dqn SBC_line_search")
ROOT = Path(__file__).parents[2]


def check_left(p: Plan) -> None:
    """Assert that an interrupted run left a checkpoint and only whole files."""
    assert list(p.directory.glob("checkpoint_*.npz"))
    assert not list(p.directory.glob(".*"))  # neither locks nor half a file
    assert about(p, 0)["status"] == "running" and is_intact(about(p, 0))


class Countdown(Stop):
    """Requests a stop when it is checked for the `left`-th time."""

    left = 0
    __init__ = object.__init__

    @property
    def requested(self) -> bool:
        self.left -= 1
        return self.left <= 0


#: A kind of run, and after how many checks it stops.
STOPS = [("maze BC", 5), ("dqn C", 330), ("dqn SBC_line_search", 180)]


@pytest.mark.parametrize(("kind", "steps"), STOPS)
def test_a_run_that_stops_often_ends_in_equal_files(tmp_path, monkeypatch, kind, steps):
    calm = run(tmp_path / "calm", *KINDS[kind])
    p = plan(*KINDS[kind], f"runs_dir={tmp_path}/here", "checkpoint_every=1e9")
    monkeypatch.setattr(runner, "Stop", Countdown)
    monkeypatch.setattr(Countdown, "left", steps)
    stops = 0
    while pending(p):
        with suppress(Interrupted):
            runner.run(p)
            break
        stops += 1
        check_left(p)
    assert stops >= 3 and about(p, 0)["interruptions"] == stops
    assert compared(calm, p) is None


def interrupted(folder: Path, *choice: str):
    """A plan with a checkpoint in its folder, and that file."""
    p = plan(*choice, f"runs_dir={folder}")
    with pytest.MonkeyPatch.context() as patch:
        at_row(patch, 6, lambda: signal.raise_signal(signal.SIGTERM))
        with pytest.raises(Interrupted):
            runner.run(p)
    (path,) = p.directory.glob("checkpoint_*.npz")
    return p, path


def test_a_damaged_checkpoint_is_rejected_by_name(tmp_path):
    class Evil:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'canary'}",)

    p, path = interrupted(tmp_path, *MAZE)
    good = path.read_bytes()
    half = good[: len(good) // 2]
    flipped = half + bytes([good[len(half)] ^ 1]) + good[len(half) + 1 :]
    for bad in (pickle.dumps(Evil()), half, b"", good[:-60], flipped):
        path.write_bytes(bad)
        with pytest.raises(BcrlError, match=f"{path.name} can't be read.*remove it"):
            runner.run(p)
    assert not (tmp_path / "canary").exists()
    path.unlink()
    runner.run(p)
    assert pending(p) == []


def test_a_checkpoint_of_other_code_or_config_counts_as_absent(tmp_path, monkeypatch):
    p, path = interrupted(tmp_path, *TABULAR)
    read = Path.read_bytes
    with monkeypatch.context() as patch:
        patch.setattr(Path, "read_bytes", lambda p: read(p) + b"#" * ("fqi" in p.name))
        importlib.reload(checkpoints)  # a module of ours has changed
        assert not checkpoints.batches(p)
    importlib.reload(checkpoints)
    assert list(checkpoints.batches(p)) == [(0, 1)]
    stored = dict(np.load(path))
    known = json.loads(stored["about"].tobytes())
    for key in ("code", "sources", "config", "device"):
        text = json.dumps(known | {key: "another"}).encode()
        np.savez(path, **stored | {"about": np.frombuffer(text, np.uint8)})
        assert not checkpoints.batches(p) and path.exists(), key
    runner.run(p)  # from the start
    assert about(p, 0)["interruptions"] == 0 and not path.exists()


def test_other_seeds_than_a_checkpoints_start_by_themselves(tmp_path):
    p, path = interrupted(tmp_path, *TABULAR, "seeds.count=3")
    one = run(tmp_path, *TABULAR, "seeds.count=1")
    assert path.exists()  # of use to a command for all three seeds
    done = (one.directory / "seed_0000.csv").stat().st_mtime_ns
    runner.run(p)
    assert (p.directory / "seed_0000.csv").stat().st_mtime_ns == done
    assert not path.exists() and pending(p) == []


def test_a_seed_has_one_holder_who_is_named_and_whose_death_frees_it(tmp_path):
    lock, other = (locks.Lock(tmp_path, "seed_0007") for _ in range(2))
    assert lock.acquire() and not other.acquire() and locks.is_held(tmp_path, 7)
    assert str(os.getpid()) in other.holder()
    lock.release()
    assert list(tmp_path.iterdir()) == [] and not locks.is_held(tmp_path, 7)
    # Of a process that died:
    left = "seed_0007.lock seed_0007.csv.1.tmp checkpoint_0007_a.npz.1.tmp"
    for name in left.split():
        (tmp_path / f".{name}").touch()
    assert not locks.is_held(tmp_path, 7)
    locks.tidy(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("code", ["ENOLCK", "EIO"])
def test_a_file_system_without_locks_is_rejected(tmp_path, monkeypatch, code):
    def flock(*_):
        raise OSError(getattr(errno, code), "words of the system")

    monkeypatch.setattr(locks.fcntl, "flock", flock)
    with pytest.raises(BcrlError, match=f"runs_dir: .*{tmp_path}.*words of the system"):
        locks.Lock(tmp_path, "seed_0007").acquire()


def kill(folder: Path, name: str) -> dict:
    """What `tests.run.killing` finds."""
    arguments = [str(folder), "1", str(KILLS or 3), name]
    command = [sys.executable, "-m", "tests.run.killing", *arguments]
    found = json.loads(subprocess.check_output(command, cwd=ROOT))
    assert found["problem"] is None, found
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS if KILLS else FEW)
def test_a_run_killed_at_any_moment_resumes_and_ends_in_equal_files(tmp_path, name):
    assert kill(tmp_path, name)["kills"] == (KILLS or 3)


@pytest.mark.slow
@pytest.mark.parametrize("processes", [2, 8])
def test_each_seed_is_computed_once_by_racing_processes(tmp_path, processes):
    assert kill(tmp_path, f"race of {processes}")["computed"] == list(range(6))


LONG = ("env=maze", "curriculum=on", "boosting=on", "tag=x", "seeds.count=2")
LONG += ("seeds.lockstep=1", "algorithm.iterations=15", "threads=1")
#: A shell's background jobs, and so perhaps this test, ignore SIGINT from the start.
PROGRAM = """
import signal, sys
from bcrl.cli import main
sys.argv[0] = "bcrl"
signal.signal(signal.SIGINT, signal.default_int_handler)
main()
"""


@pytest.fixture(scope="module")
def calm(tmp_path_factory):
    """The run without a disturbance."""
    return run(tmp_path_factory.mktemp("calm"), *LONG, "progress=none")


def signals(*numbers: int):
    return lambda process, p: [process.send_signal(number) for number in numbers]


#: The number of workers, what happens once they train, and the possible exit codes.
DISTURBED = {
    "SIGHUP": (1, signals(signal.SIGHUP), [75]),
    "SIGUSR1": (2, signals(signal.SIGUSR1), [75]),
    "Ctrl-C": (2, lambda process, p: os.killpg(process.pid, signal.SIGINT), [75]),
    "twice": (1, signals(signal.SIGTERM, signal.SIGTERM), [-signal.SIGTERM, 75]),
    "killed": (2, signals(signal.SIGKILL), [-signal.SIGKILL]),
    "a killed worker": (2, lambda _, p: os.kill(about(p, 0)["pid"], 9), [1]),
    # 120: Python can't flush its stream.
    "a closed terminal": (1, lambda process, p: process.stderr.close(), [0, 120]),
}


@pytest.mark.slow
@pytest.mark.parametrize("how", DISTURBED)
def test_a_disturbed_command_saves_resumes_and_ends_in_equal_files(tmp_path, calm, how):
    workers, disturb, codes = DISTURBED[how]
    p = plan(*LONG, f"runs_dir={tmp_path}")
    words = [*LONG, f"runs_dir={tmp_path}", f"workers={workers}", "progress=lines"]
    kept = {"stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    process = subprocess.Popen([sys.executable, "-c", PROGRAM, *words], **kept)
    process.stderr.readline()  # it trains
    disturb(process, p)
    text = process.communicate(timeout=180)[1] or ""
    assert process.returncode in codes and "Traceback" not in text, text
    if codes == [75]:
        assert "run the same command again" in text
        check_left(p)
    if codes == [1]:
        assert pending(p) == [0] and "1 seed failed" in text
        assert "killed (out of memory?" in text
        assert "to run just this again:\n  bcrl env=maze curriculum=on" in text
    runner.run(p)
    assert compared(calm, p) is None
