"""Signals that request a stop: work in progress ends at its next pause."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from bcrl.common.terminal import GONE

#: Ctrl-C, a scheduler's stop, a lost terminal, and the early warnings of Slurm.
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)
EXIT_CODE = 75  # EX_TEMPFAIL: nothing is wrong, run the same command again


class Interrupted(BaseException):
    """A signal has ended the work; the checkpoints are written."""


class Stop:
    """Whether a stop was requested, by a signal or from within."""

    def __init__(self) -> None:
        self.requested = False

    @contextmanager
    def on_signals(self) -> Iterator[None]:
        """Signals, unless ignored (nohup), request a stop; the same again ends all."""
        came = set()  # a scheduler may send two kinds, one soon after the other

        def note(number: int, frame: Any) -> None:
            if number in came:
                signal.signal(number, signal.SIG_DFL)
                os.kill(os.getpid(), number)
            if not self.requested:
                name = signal.Signals(number).name
                text = f"bcrl: {name}: saving; once more to quit\n"
                with suppress(*GONE):
                    os.write(2, text.encode())  # print may be interrupted itself
            came.add(number)
            self.requested = True

        used = [n for n in SIGNALS if signal.getsignal(n) is not signal.SIG_IGN]
        before = {number: signal.signal(number, note) for number in used}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
