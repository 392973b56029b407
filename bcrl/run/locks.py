"""Locks on seeds: one process computes a seed, on one machine or a shared file system.

The kernel holds them (flock, through filelock), so a process that dies loses its locks.
"""

import errno
import fcntl
import os
import socket
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from bcrl.errors import BcrlError
from bcrl.results.layout import CHECKPOINT, SEED, seed_name


class Lock:
    """A lock on the files of a folder whose names begin with `name`."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name = folder, name
        self.path = folder / f".{name}.lock"
        # Never a lock by a file's mere existence: it would outlive a killed process.
        self._lock = FileLock(self.path, thread_local=False, fallback_to_soft=False)
        self._file: os.stat_result | None = None

    def acquire(self, seconds: float = 0.0) -> bool:
        """Take the lock in `seconds`; False if another has it, BcrlError on errors."""
        try:
            self._lock.acquire(timeout=seconds)
        except Timeout:
            return False
        except OSError as error:
            why = f"cannot write or lock {self.path}: {error.strerror}"
            if error.errno in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
                why += "; mount it with locks (Lustre: -o flock) or name another folder"
            raise BcrlError(f"runs_dir: {why}") from error
        with suppress(OSError):
            self.path.write_text(f"process {os.getpid()} on {socket.gethostname()}")
            self._file = os.stat(self.path)
        # A batch's checkpoint belongs to its first seed.
        for start in (f"{self.name}.", f"{self.name}_".replace(SEED, CHECKPOINT)):
            for left in self.folder.glob(f".{start}*.tmp"):
                left.unlink(missing_ok=True)
        return True

    def release(self) -> None:
        """Give the lock up and remove its file."""
        if self.holds():
            with suppress(OSError):
                self.path.unlink()
        self._lock.release()

    def holds(self) -> bool:
        """Whether the lock is ours and its folder still the one it was taken in."""
        with suppress(OSError):
            same = self._file and os.path.samestat(self._file, os.stat(self.path))
            return bool(same) and self._lock.is_locked
        return False

    def holder(self) -> str:
        """The process that holds the lock, by its own words."""
        with suppress(OSError):
            return self.path.read_text("utf-8", "replace")
        return "another process"


def is_held(folder: Path, seed: int) -> bool:
    """Whether a process is computing this seed; the check writes nothing."""
    try:
        with open(Lock(folder, seed_name(seed)).path, "rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return isinstance(error, BlockingIOError)
    return False


@contextmanager
def claimed(folder: Path, seeds: Sequence[int]) -> Iterator[dict[int, Lock]]:
    """The locks of those seeds that no other process has, until the end of a block."""
    with ExitStack() as stack:
        held = {}
        for seed in seeds:
            if (lock := Lock(folder, seed_name(seed))).acquire():
                held[seed] = lock
                stack.callback(lock.release)
        yield held


def tidy(folder: Path) -> None:
    """Remove lock files and half-written files of processes that died."""
    for path in folder.glob(".*.lock"):
        if (lock := Lock(folder, path.stem.removeprefix("."))).acquire():
            lock.release()
