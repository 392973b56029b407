"""Locks on seeds: one process computes a seed, on one machine or a shared file system.

They are the kernel's (flock), so a dead process holds none; its lock file is only a
file. What a lock file says is for people: who holds it.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from bcrl.common.files import remove_half_written
from bcrl.errors import BcrlError

SEED = "seed_"
WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


class Lock:
    """A lock on files of a folder whose names begin with `name`."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name = folder, name
        self.path = folder / f".{name}.lock"
        self._handle: int | None = None

    def acquire(self) -> bool:
        """Take the lock; False if another process has it.

        What a process that died while writing has left behind is removed. Raises
        BcrlError where files can't be made or locked.
        """
        while True:
            try:
                handle = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o666)
            except OSError as error:
                why = f"cannot write {self.path}: {error.strerror}"
                raise BcrlError(why) from error
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if self._is_at_path(handle):  # else its holder has just removed it
                    break
                os.close(handle)
            except BlockingIOError:
                os.close(handle)
                return False
            except OSError as error:
                os.close(handle)
                raise BcrlError(_without(self.folder, error)) from error
        self._handle = handle
        with contextlib.suppress(OSError):  # it says who, no more
            os.ftruncate(handle, 0)
            who = f"process {os.getpid()} on {socket.gethostname()}"
            os.write(handle, who.encode())
        remove_half_written(self.folder, f"{self.name}.")
        if self.name.startswith(SEED):  # a team's checkpoint is its first seed's
            checkpoint = self.name.replace(SEED, "checkpoint_")
            remove_half_written(self.folder, f"{checkpoint}_")
        return True

    def release(self) -> None:
        """Give the lock up, its file removed."""
        if self._handle is not None:
            if self._is_at_path(self._handle):
                with contextlib.suppress(OSError):  # the lock counts, not its file
                    self.path.unlink()
            os.close(self._handle)
            self._handle = None

    def holds(self) -> bool:
        """Whether the lock is ours and its folder still the one it was taken in."""
        return self._handle is not None and self._is_at_path(self._handle)

    def holder(self) -> str:
        """Who says to hold it."""
        try:
            return self.path.read_text("utf-8", "replace") or "another process"
        except OSError:
            return "another process"

    def _is_at_path(self, handle: int) -> bool:
        try:
            return os.path.samestat(os.fstat(handle), os.stat(self.path))
        except OSError:
            return False


def seed_lock(folder: Path, seed: int) -> Lock:
    """The lock of a seed's files."""
    return Lock(folder, f"{SEED}{seed:04d}")


def is_held(folder: Path, seed: int) -> bool:
    """Whether a process is computing this seed; nothing is written to find out."""
    try:
        handle = os.open(seed_lock(folder, seed).path, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return isinstance(error, BlockingIOError)
    finally:
        os.close(handle)
    return False


@contextlib.contextmanager
def claimed(folder: Path, seeds: Sequence[int]) -> Iterator[dict[int, Lock]]:
    """The locks of those of the seeds that no other process has, for a while."""
    held: dict[int, Lock] = {}
    try:
        for seed in seeds:
            lock = seed_lock(folder, seed)
            if lock.acquire():
                held[seed] = lock
        yield held
    finally:
        for lock in held.values():
            lock.release()


@contextlib.contextmanager
def waited_for(folder: Path, name: str, seconds: float = 60.0) -> Iterator[None]:
    """A lock that is held for moments only; BcrlError if it never gets free."""
    lock, tries = Lock(folder, name), max(1, int(seconds / 0.05))
    for _ in range(tries):
        if lock.acquire():
            break
        time.sleep(0.05)
    else:
        raise BcrlError(f"{lock.path} is held by {lock.holder()} for {seconds:.0f} s")
    try:
        yield
    finally:
        lock.release()


def tidy(folder: Path) -> None:
    """Remove the lock files, and what was half written, of processes that died."""
    for path in folder.glob(".*.lock"):
        lock = Lock(folder, path.name.removeprefix(".").removesuffix(".lock"))
        if lock.acquire():
            lock.release()


def _without(folder: Path, error: OSError) -> str:
    if error.errno in WITHOUT_LOCKS:
        return (
            f"runs_dir: {folder} is on a file system without file locks "
            f"({error.strerror}): mount it with locks (Lustre: -o flock) or name "
            "another folder"
        )
    return f"runs_dir: {folder} can't be locked: {error.strerror}"
