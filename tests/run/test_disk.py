"""A full disk, a read-only one, a folder that is removed: reported, nothing lost."""

import errno
import os
import shutil
import subprocess

import numpy as np
import pytest

from bcrl.common import files
from bcrl.errors import BcrlError
from bcrl.run import job, runner
from bcrl.run.records import is_complete, pending
from tests.conftest import plan
from tests.run.runs import MAZE, compared, run

CHOICE = (*MAZE, "seeds.count=4", "seeds.lockstep=1")


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


def test_a_full_or_read_only_disk_keeps_the_complete_seeds(tmp_path, disk, monkeypatch):
    p = plan(*CHOICE, f"runs_dir={disk}")
    train = job.train

    def then_nothing_can_be_written(some, *rest):
        outcome = train(some, *rest)
        remount(disk, "ro")
        return outcome

    with monkeypatch.context() as patched:
        patched.setattr(job, "train", then_nothing_can_be_written)
        with pytest.raises(runner.SeedsFailed, match="Read-only file system"):
            runner.run(p)
    assert len(pending(p)) == 3
    with pytest.raises(BcrlError, match="no permission to write"):
        runner.run(p)  # now it is known before any work
    remount(disk, "rw,size=600k")
    with pytest.raises(runner.SeedsFailed, match="No space left on device") as failed:
        runner.run(p)
    assert "cannot write" in str(failed.value)
    assert 1 <= len(pending(p)) < 4
    assert not list(p.directory.glob(".*.tmp"))
    remount(disk, "size=4m")
    runner.run(p)
    assert compared(run(tmp_path / "calm", *CHOICE), p) is None


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EIO])
def test_any_failing_write_is_named(tmp_path, monkeypatch, code):
    p = plan(*MAZE, "variant=plain", f"runs_dir={tmp_path}")
    real, calls = os.fsync, []

    def fsync(handle):
        calls.append(1)
        if len(calls) > 5:
            raise OSError(code, os.strerror(code))
        real(handle)

    with monkeypatch.context() as patched:
        patched.setattr(files.os, "fsync", fsync)
        with pytest.raises(runner.SeedsFailed) as failed:
            runner.run(p)
    assert f"cannot write {p.directory}" in str(failed.value)
    assert os.strerror(code) in str(failed.value)
    assert not list(p.directory.glob(".*.tmp"))
    runner.run(p)
    assert pending(p) == []


@pytest.mark.parametrize("replaced", [False, True])
def test_a_folder_removed_in_the_middle_is_not_made_anew(
    tmp_path, monkeypatch, replaced
):
    kept = run(tmp_path, "env=maze", "scale=smoke", "progress=none")
    earlier = {f: f.read_bytes() for f in kept.directory.iterdir()}
    p = plan(*MAZE, "seeds.count=1", f"runs_dir={tmp_path}")
    measure, seen = job._Training.measure, []

    def then_remove(self, snapshot):
        measure(self, snapshot)
        seen.append(snapshot)
        if len(seen) == 5:
            shutil.rmtree(p.directory)
            if replaced:
                p.directory.mkdir()

    with monkeypatch.context() as patched:
        patched.setattr(job._Training, "measure", then_remove)
        with pytest.raises(runner.SeedsFailed, match="removed or replaced") as failed:
            runner.run(p)
    assert str(p.directory) in str(failed.value)
    if replaced:  # no stray files
        assert [f.name for f in p.directory.iterdir()] in ([], ["seed_0000.json"])
    else:
        assert not p.directory.exists()
    assert {f: f.read_bytes() for f in kept.directory.iterdir()} == earlier
    runner.run(p)
    assert is_complete(p.directory, 0)


def test_a_half_written_file_is_never_seen(tmp_path):
    """A failing write leaves the old file, and nothing beside it."""
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
