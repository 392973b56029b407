"""What is said on the terminal; that nobody reads it any more is no reason to fail."""

from __future__ import annotations

import contextlib
import os
import sys

#: What a closed pipe, terminal or stream may raise.
GONE = (OSError, ValueError, AttributeError)
STREAMS = ("stdin", "stdout", "stderr")  # by file descriptor


def ready() -> None:
    """Make the standard streams usable: the first thing that a command does.

    A closed one becomes the null device, or the next file opened would take its
    descriptor. Characters that the locale lacks are printed as escapes.
    """
    for number, name in enumerate(STREAMS):
        with contextlib.suppress(OSError):
            if not _is_open(number):  # the lowest free descriptor, so this one
                os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
        if getattr(sys, name) is None:
            mode = "w" if number else "r"
            # By its usual number, which processes that are started take over.
            stream = open(number, mode, encoding="utf-8", closefd=False)  # noqa: SIM115
            setattr(sys, name, stream)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(*GONE):  # a stream of a test's or a notebook's
            stream.reconfigure(errors="backslashreplace")
    # numba can't be imported with another number, and our loops have to be compiled.
    if not count("NUMBA_NUM_THREADS"):
        os.environ.pop("NUMBA_NUM_THREADS", None)
    if os.environ.pop("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        say("bcrl: NUMBA_DISABLE_JIT is ignored: its loops have to be compiled")


def _is_open(descriptor: int) -> bool:
    try:
        os.fstat(descriptor)
    except OSError:
        return False
    return True


def count(variable: str) -> int | None:
    """An environment variable's value if it is a number of at least 1, else None."""
    value = os.environ.get(variable, "")
    return int(value) or None if value.isdecimal() else None


def say(text: str) -> None:
    """A line on standard error."""
    with contextlib.suppress(*GONE):
        print(text, file=sys.stderr, flush=True)


def show(text: str) -> None:
    """What was asked for, on standard output, as far as anybody reads it."""
    try:
        print(text, flush=True)
    except OSError as error:
        if not isinstance(error, BrokenPipeError):  # a full disk, say
            say(f"bcrl: standard output can't be written: {error.strerror}")
        # What is still buffered must not fail again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
