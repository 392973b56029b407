"""Signals that ask to stop: work that is under way ends at its next pause."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType

from bcrl.common.terminal import GONE

#: Ctrl-C, a scheduler's end, a lost terminal, and the early warnings that one may ask
#: Slurm for.
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SIGNALS += (signal.SIGUSR1, signal.SIGUSR2)
EXIT_CODE = 75  # EX_TEMPFAIL: nothing is wrong, run the same command again


def heard() -> None:
    """From now on Ctrl-C is an exception, no end without a word."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)


class Interrupted(BaseException):
    """A signal has ended the work; what was done is kept."""


class Stop:
    """Whether to stop: asked for by a signal, or from within."""

    def __init__(self) -> None:
        self.asked = False

    def ask(self) -> None:
        """Stop at the next pause."""
        self.asked = True

    @contextlib.contextmanager
    def on_signals(self, second_ends_all: bool) -> Iterator[None]:
        """Meanwhile signals only ask; one that comes again may end the process at once.

        Those that are ignored (as by nohup) stay so.
        """
        if threading.current_thread() is not threading.main_thread():
            yield  # whose thread it is gets the signals
            return

        came = set()  # a scheduler may send two kinds, one soon after the other

        def note(number: int, frame: FrameType | None) -> None:
            if number in came and second_ends_all:
                signal.signal(number, signal.SIG_DFL)
                os.kill(os.getpid(), number)
            if not self.asked and second_ends_all:
                name = signal.Signals(number).name
                # Not print: the signal may have come in the middle of one.
                text = f"bcrl: {name}: saving; once more to quit at once\n"
                with contextlib.suppress(*GONE):
                    os.write(sys.__stderr__.fileno(), text.encode())
            came.add(number)
            self.ask()

        heard = [n for n in SIGNALS if signal.getsignal(n) is not signal.SIG_IGN]
        before = {number: signal.signal(number, note) for number in heard}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
