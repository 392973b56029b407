"""What the benches share: calls timed by turns."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence


def one_core() -> None:
    """Keep this process, with all threads that libraries start later, on one core."""
    if hasattr(os, "sched_setaffinity"):  # Linux
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def by_turns(calls: Sequence[Callable[[], object]], turns: int) -> list[float]:
    """The least CPU seconds of a call of each, none of them timed in a row."""
    best = [float("inf")] * len(calls)
    for _ in range(turns):
        for i, call in enumerate(calls):
            began = time.process_time()
            call()
            best[i] = min(best[i], time.process_time() - began)
    return best
