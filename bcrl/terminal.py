"""What is said on the terminal; that nobody reads it any more is no reason to fail."""

from __future__ import annotations

import contextlib
import sys

#: What a closed pipe, terminal or stream may raise.
GONE = (OSError, ValueError, AttributeError)


def say(text: str) -> None:
    """A line on standard error."""
    with contextlib.suppress(*GONE):
        print(text, file=sys.stderr, flush=True)
