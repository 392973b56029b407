"""How far all jobs are, and when they will be done: a bar, or a line now and then."""

from __future__ import annotations

import contextlib
import heapq
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

from tqdm import tqdm

from bcrl.common.terminal import GONE, say

LINE_EVERY = 0.1  # share of the work between two lines, where no job ends
SILENCE = 30.0  # seconds after which a line is due anyhow
REFRESH = 0.5  # seconds between two estimates in a bar
TRUST = 100.0  # seconds of work that the estimates weigh against what is measured


@dataclass(frozen=True)
class Job:
    """A group of seeds that one process trains, and what that is expected to take."""

    name: str  # "maze BC-FQI"
    kind: str  # what is estimated alike: jobs of one kind are off by one factor
    seeds: tuple[int, ...]
    length: int  # iterations or steps
    unit: str
    seconds: float  # of one core, expected


@dataclass(frozen=True)
class Tick:
    """How far a job is."""

    job: int  # number in the list of jobs
    task: int
    count: int  # iterations or steps done
    spent: float  # seconds since it began


class Progress:
    """Shows the ticks of jobs that `workers` take in order, in a mode of the YAML's."""

    def __init__(self, jobs: Sequence[Job], workers: int, mode: str) -> None:
        if mode == "auto":
            mode = "bar" if getattr(sys.stderr, "isatty", bool)() else "lines"
        self.jobs, self.workers, self.mode = jobs, workers, mode
        self.share = [0.0] * len(jobs)  # of each job, done
        self.spent = [0.0] * len(jobs)
        self.total, self.done = sum(job.seconds for job in jobs), 0.0  # seconds
        self.began = time.monotonic()
        self._shown = (0.0, self.began)  # share and time of the last line
        shape = "{desc} |{bar}| {percentage:3.0f}% {elapsed}{postfix}"
        self.bar = None
        if mode == "bar":
            try:
                self.bar = tqdm(total=1.0, bar_format=shape)
            except (ValueError, TypeError):  # a TQDM_* variable that tqdm can't read
                self.mode = "lines"

    def tick(self, tick: Tick) -> None:
        """Note how far a job is, and show it."""
        job = self.jobs[tick.job]
        share, self.spent[tick.job] = tick.count / job.length, tick.spent
        self.done += job.seconds * (share - self.share[tick.job])
        self.share[tick.job] = share
        where = (
            f"{job.name} · T{tick.task} · {job.unit} {tick.count}/{job.length}"
            f" · {named(job.seeds)}"
        )
        all_done = sum(self.share) == len(self.jobs)
        done = 1.0 if all_done else self.done / self.total
        now, (shown, last) = time.monotonic(), self._shown
        if self.bar is not None:
            self.bar.set_description_str(where, refresh=False)
            if now >= last + REFRESH or all_done:
                self._shown = done, now
                self.bar.set_postfix_str(f"{_clock(self.to_go())} to go", refresh=False)
            with contextlib.suppress(*GONE):
                self.bar.update(done - self.bar.n)
        elif self.mode == "lines":
            due = done >= shown + LINE_EVERY or now >= last + SILENCE
            if due or tick.count == job.length:
                self._shown = done, now
                left = f", {_clock(self.to_go())} to go" * (not all_done)
                line = f"{where} · {done:4.0%} · {_clock(now - self.began)}{left}"
                say(line)

    def to_go(self) -> float:
        """Seconds until the last job ends.

        What was expected of the rest, corrected by what jobs of the kind have taken so
        far, is handed to whichever worker is free next, as the runner does.
        """
        taken: dict[str, list[float]] = {"": [TRUST, TRUST]}
        for job, share, spent in zip(self.jobs, self.share, self.spent, strict=True):
            for kind in (job.kind, ""):
                sums = taken.setdefault(kind, [TRUST, TRUST])
                sums[0] += spent
                sums[1] += job.seconds * share
        free = [0.0] * self.workers
        for job, share in zip(self.jobs, self.share, strict=True):
            began = taken[job.kind][1] > TRUST
            spent, expected = taken[job.kind if began else ""]
            left = job.seconds * (1.0 - share) * spent / expected
            heapq.heapreplace(free, free[0] + left)
        return max(free)

    def close(self) -> None:
        """Leave the terminal tidy."""
        if self.bar is not None:
            with contextlib.suppress(*GONE):
                self.bar.close()


def _clock(seconds: float) -> str:
    return tqdm.format_interval(seconds)


def named(seeds: Sequence[int]) -> str:
    """`seeds 0–19`, or one by one if they are not in a row."""
    first, last = seeds[0], seeds[-1]
    if last - first + 1 == len(seeds) > 1:
        return f"seeds {first}–{last}"
    return f"seed{'s' * (len(seeds) > 1)} " + ", ".join(map(str, seeds))
