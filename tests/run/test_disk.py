"""A full disk, a read-only one, a folder that is removed: reported, nothing lost."""

import errno
import os
import shutil
import subprocess

import pytest

from bcrl.errors import BcrlError
from bcrl.run import runner
from bcrl.run.records import pending
from tests.conftest import plan
from tests.run.runs import MAZE, TABULAR, at_row, compared, run

CHOICE = (*MAZE, "seeds.count=4", "seeds.lockstep=1")


@pytest.fixture
def mount(tmp_path):
    """Mounts a file system at `tmp_path/disk`, or again with other options."""
    (folder := tmp_path / "disk").mkdir()

    def act(options: str) -> None:
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            pytest.skip(f"can't mount a tmpfs: {done.stderr.strip()}")

    yield act
    subprocess.run(["umount", "-l", str(folder)], capture_output=True)


def test_a_full_or_read_only_disk_keeps_complete_seeds(tmp_path, mount, monkeypatch):
    mount("size=600k")  # room for two or three seeds of the maze
    p = plan(*CHOICE, f"runs_dir={tmp_path}/disk")
    with monkeypatch.context() as patch:
        at_row(patch, 21, lambda: mount("remount,ro"))  # the second seed's first
        with pytest.raises(runner.SeedsFailed, match="Read-only file system"):
            runner.run(p)
    assert len(pending(p)) == 3
    with pytest.raises(BcrlError, match="no permission to write"):
        runner.run(p)  # now it is known before any work
    mount("remount,rw,size=600k")
    with pytest.raises(runner.SeedsFailed, match=r"cannot write .*No space left"):
        runner.run(p)
    assert 1 <= len(pending(p)) < 4
    mount("remount,size=4m")
    runner.run(p)
    assert compared(run(tmp_path / "calm", *CHOICE), p) is None


@pytest.mark.parametrize("code", [errno.EDQUOT, errno.EIO])
def test_any_failing_write_is_named(tmp_path, monkeypatch, code):
    p = plan(*TABULAR, f"runs_dir={tmp_path}")
    real, calls = os.fsync, []

    def fsync(handle):
        calls.append(handle)
        if len(calls) > 5:
            raise OSError(code, os.strerror(code))
        real(handle)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fsync)
        with pytest.raises(runner.SeedsFailed, match=os.strerror(code)) as failed:
            runner.run(p)
    assert f"cannot write {p.directory}" in str(failed.value)
    assert not list(p.directory.glob(".*.tmp"))
    runner.run(p)
    assert pending(p) == []


@pytest.mark.parametrize("replaced", [False, True])
def test_a_removed_folder_is_not_made_anew(tmp_path, monkeypatch, replaced):
    p = plan(*TABULAR, "seeds.count=1", f"runs_dir={tmp_path}")

    def remove():
        shutil.rmtree(p.directory)
        if replaced:
            p.directory.mkdir()

    with monkeypatch.context() as patch:
        at_row(patch, 5, remove)
        with pytest.raises(runner.SeedsFailed, match="removed or replaced"):
            runner.run(p)
    assert p.directory.exists() == replaced
    left = [path.name for path in p.directory.glob("*")]
    assert left in ([], ["seed_0000.json"])  # no stray files
    runner.run(p)
    assert pending(p) == []
