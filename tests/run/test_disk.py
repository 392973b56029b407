"""A full disk, one that can't be written, a folder taken away: said, nothing lost."""

import errno
import os
import shutil
import subprocess

import numpy as np
import pytest

from bcrl.common import files
from bcrl.errors import BcrlError
from bcrl.run import job as training
from bcrl.run import runner
from bcrl.run.records import is_complete
from tests.conftest import plan
from tests.run import killing

CHOICE = ("env=maze", "variant=BC", "scale=smoke", "progress=none")
CHOICE += ("seeds.count=4", "seeds.lockstep=1")


@pytest.fixture
def disk(tmp_path):
    """A file system of 600 KiB: room for two or three seeds of the maze."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=600k", "tmpfs", str(folder)]
    done = subprocess.run(mount, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"can't mount a tmpfs: {done.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def remount(folder, option: str) -> None:
    command = ["mount", "-o", f"remount,{option}", str(folder)]
    subprocess.run(command, check=True)


def calm(tmp_path):
    p = plan(*CHOICE, f"runs_dir={tmp_path / 'calm'}")
    runner.run(p)
    return p


def at_snapshot(monkeypatch, number: int, act) -> None:
    """`act` once, when so many snapshots have been looked at."""
    look, seen = training._measure, []

    def then(*arguments):
        look(*arguments)
        seen.append(1)
        if len(seen) == number:
            act()

    monkeypatch.setattr(training, "_look", then)


def test_a_full_disk_keeps_what_is_complete(tmp_path, disk):
    p = plan(*CHOICE, f"runs_dir={disk}")
    with pytest.raises(runner.SeedsFailed, match="No space left on device") as failed:
        runner.run(p)
    assert "cannot write" in str(failed.value)
    done = [seed for seed in p.seeds if is_complete(p.directory, seed)]
    assert 1 <= len(done) < 4
    assert not list(p.directory.glob(".*.tmp"))
    remount(disk, "size=4m")
    runner.run(p)
    assert killing.compared(calm(tmp_path), p) is None


def test_a_disk_that_becomes_read_only_keeps_what_is_complete(
    tmp_path, disk, monkeypatch
):
    p = plan(*CHOICE, f"runs_dir={disk}")
    train = training.train

    def then_nothing_can_be_written(job, *rest):
        outcome = train(job, *rest)
        if job.number == 0:
            remount(disk, "ro")
        return outcome

    monkeypatch.setattr(training, "train", then_nothing_can_be_written)
    with pytest.raises(runner.SeedsFailed, match="Read-only file system"):
        runner.run(p)
    with pytest.raises(BcrlError, match="no permission to write"):
        runner.run(p)  # now it is known before any work
    assert [is_complete(p.directory, seed) for seed in p.seeds].count(True) == 1
    monkeypatch.undo()
    remount(disk, "rw,size=4m")
    runner.run(p)
    assert killing.compared(calm(tmp_path), p) is None


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EIO])
def test_any_failing_write_is_named(tmp_path, monkeypatch, code):
    p = plan(*CHOICE, f"runs_dir={tmp_path}")
    real, calls = os.fsync, []

    def fsync(handle):
        calls.append(1)
        if len(calls) > 30:
            raise OSError(code, os.strerror(code))
        real(handle)

    monkeypatch.setattr(files.os, "fsync", fsync)
    with pytest.raises(runner.SeedsFailed) as failed:
        runner.run(p)
    assert f"cannot write {p.directory}" in str(failed.value)
    assert os.strerror(code) in str(failed.value)
    monkeypatch.undo()
    assert not list(p.directory.glob(".*.tmp"))
    runner.run(p)
    assert all(is_complete(p.directory, seed) for seed in p.seeds)


def test_a_folder_removed_in_the_middle_is_not_made_anew(tmp_path, monkeypatch):
    kept = plan("env=maze", "scale=smoke", "progress=none", f"runs_dir={tmp_path}")
    runner.run(kept)
    earlier = {f: f.read_bytes() for f in kept.directory.iterdir()}
    p = plan(*CHOICE, "seeds.count=1", f"runs_dir={tmp_path}")
    at_snapshot(monkeypatch, 5, lambda: shutil.rmtree(p.directory))
    with pytest.raises(runner.SeedsFailed, match="was removed or replaced") as failed:
        runner.run(p)
    assert str(p.directory) in str(failed.value)
    assert not p.directory.exists()
    assert {f: f.read_bytes() for f in kept.directory.iterdir()} == earlier
    runner.run(p)
    assert is_complete(p.directory, 0)


def test_a_folder_replaced_in_the_middle_gets_no_stray_files(tmp_path, monkeypatch):
    p = plan(*CHOICE, "seeds.count=1", f"runs_dir={tmp_path}")

    def replace():
        shutil.rmtree(p.directory)
        p.directory.mkdir()

    at_snapshot(monkeypatch, 5, replace)
    with pytest.raises(runner.SeedsFailed, match="was removed or replaced"):
        runner.run(p)
    assert [f.name for f in p.directory.iterdir()] in ([], ["seed_0000.json"])


def test_a_half_written_file_is_never_seen(tmp_path):
    """Whoever fails while it writes leaves the old file, and nothing beside it."""
    path = tmp_path / "numbers.npz"
    files.write_atomically(path, lambda file: np.savez(file, a=np.arange(3)))

    def fail(file):
        file.write(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(BcrlError, match=r"cannot write .*numbers.npz: No space left"):
        files.write_atomically(path, fail)
    assert [f.name for f in tmp_path.iterdir()] == ["numbers.npz"]
    assert np.load(path)["a"].tolist() == [0, 1, 2]
    with pytest.raises(BcrlError, match=r"the folder .*/nowhere is gone"):
        files.write_text(tmp_path / "nowhere" / "x", "")
