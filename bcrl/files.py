"""Files that are whole or absent: written beside their place, then moved into it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from bcrl.errors import BcrlError


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> Path:
    """Let `write` fill a hidden neighbour of `path`, then rename it to `path`.

    A reader sees the old file or the new one, never half of one. Raises BcrlError if
    the folder cannot be written to.
    """
    hidden = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(hidden, "wb") as handle:
            write(handle)
            handle.flush()
            os.fsync(handle.fileno())
        os.replace(hidden, path)
    except OSError as error:
        raise BcrlError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):
            hidden.unlink()
    return path


def write_text(path: Path, text: str) -> Path:
    """Write UTF-8 text with Unix line ends, atomically."""
    return write_atomically(path, lambda handle: handle.write(text.encode()))
