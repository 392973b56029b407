"""Standard streams: closed pipes and odd locales are no reason to fail."""

import os
import sys
from contextlib import suppress

#: Errors of a closed pipe, terminal or stream.
GONE = (OSError, ValueError, AttributeError)


def ready() -> None:
    """Make the standard streams usable: the first thing that a command does.

    A closed one becomes the null device, or the next file opened would take its
    descriptor. Characters that the locale lacks are printed as escapes.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            with suppress(OSError):  # takes the lowest free descriptor
                os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
        if getattr(sys, name) is None:
            mode = "w" if number else "r"
            # By its usual number, which child processes inherit.
            stream = open(number, mode, encoding="utf-8", closefd=False)  # noqa: SIM115
            setattr(sys, name, stream)
    for stream in (sys.stdout, sys.stderr):
        with suppress(*GONE):  # a stream of a test's or a notebook's
            stream.reconfigure(errors="backslashreplace")  # type: ignore
    # numba can't be imported with another number, and our loops must be compiled.
    if not count("NUMBA_NUM_THREADS"):
        os.environ.pop("NUMBA_NUM_THREADS", None)
    os.environ.pop("NUMBA_DISABLE_JIT", None)


def count(variable: str) -> int | None:
    """An environment variable's value if it is a number of at least 1, else None."""
    value = os.environ.get(variable, "")
    return int(value) or None if value.isdecimal() else None


def say(text: str) -> None:
    """Print a line on standard error."""
    with suppress(*GONE):
        print(text, file=sys.stderr, flush=True)


def show(text: str) -> None:
    """Print a command's result on standard output, as far as anybody reads it."""
    try:
        print(text, flush=True)
    except OSError as error:
        if not isinstance(error, BrokenPipeError):  # a full disk, say
            say(f"bcrl: standard output can't be written: {error.strerror}")
        # The rest of the buffer must not fail again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
