"""What is said on the terminal; that nobody reads it any more is no reason to fail."""

from __future__ import annotations

import contextlib
import os
import sys

#: What a closed pipe, terminal or stream may raise.
GONE = (OSError, ValueError, AttributeError)


def say(text: str) -> None:
    """A line on standard error."""
    with contextlib.suppress(*GONE):
        print(text, file=sys.stderr, flush=True)


def show(text: str) -> None:
    """What was asked for, on standard output, as far as anybody reads it."""
    try:
        print(text, flush=True)
    except BrokenPipeError:  # what is still buffered must not fail again at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
