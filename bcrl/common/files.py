"""Atomic files, and documents with a digest that shows changes."""

import hashlib
import json
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

from bcrl.errors import BcrlError

DIGEST = "digest"  # a sealed document's key for the hash of all its others


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> Path:
    """Let `write` fill a hidden file beside `path`, then rename it to `path`.

    A reader sees the old file or the new one, never half of one, and once this returns
    the new one survives a power cut. Raises BcrlError if it can't be written.
    """
    hidden = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(hidden, "wb") as handle:
            write(handle)
            handle.flush()
            os.fsync(handle.fileno())
        os.replace(hidden, path)
    except OSError as error:
        raise BcrlError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            hidden.unlink()
    with suppress(OSError):  # not every file system can sync a folder
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    return path


def write_bytes(path: Path, data: bytes) -> Path:
    """Write a file, atomically."""
    return write_atomically(path, lambda handle: handle.write(data))


def write_text(path: Path, text: str) -> Path:
    """Write UTF-8 text with Unix line ends, atomically."""
    return write_bytes(path, text.encode())


def user_folder(variable: str, usual: str) -> Path | None:
    """The folder XDG's `variable` names if absolute, else `usual` at home; or None."""
    for place in (os.environ.get(variable, ""), f"~/{usual}"):
        if os.path.isabs(folder := os.path.expanduser(place)):
            return Path(folder)
    return None


def make_directory(directory: Path, key: str) -> None:
    """Make a folder and those above it; BcrlError names `key` if that fails."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BcrlError(f"{key}: can't make {directory}: {error.strerror}") from error


def sha256(data: bytes) -> str:
    """The SHA-256 of a file's bytes, hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def sealed(document: dict[str, Any]) -> str:
    """A JSON object as text, with a `digest` over its values."""
    document = json.loads(json.dumps(document))  # keys become texts, as they are read
    whole = document | {DIGEST: _digest(document)}
    return json.dumps(whole, indent=1, ensure_ascii=False, allow_nan=False)


def is_intact(document: dict[str, Any]) -> bool:
    """Whether the values of a document that `sealed` wrote are unchanged."""
    return document.get(DIGEST) == _digest(document)


def _digest(document: dict[str, Any]) -> str:
    rest = {key: value for key, value in document.items() if key != DIGEST}
    return sha256(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode())
