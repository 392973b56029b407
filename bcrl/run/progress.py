"""The progress of all jobs and the time to go: a bar, or a line now and then."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from tqdm import tqdm

from bcrl.common.terminal import GONE, say
from bcrl.run.costs import makespan
from bcrl.run.records import named
from bcrl.run.schedule import Job

_LINE_EVERY = 0.1  # share of the work between two lines, where no job ends
_SILENCE = 30.0  # seconds after which a line is due in any case
_REFRESH = 0.5  # seconds between two estimates in a bar
_PRIOR = 100.0  # seconds of expected work that count as measured


@dataclass(frozen=True)
class Tick:
    """How far a job is."""

    task: int
    count: int  # iterations or steps done
    spent: float  # seconds since it began


class Progress:
    """Shows the ticks of jobs that `workers` take in order; `mode`: see config.yaml."""

    def __init__(self, jobs: Sequence[Job], workers: int, mode: str) -> None:
        if mode == "auto":
            mode = "bar" if getattr(sys.stderr, "isatty", bool)() else "lines"
        self.jobs, self.workers, self.mode = jobs, workers, mode
        self.expected = [job.seconds for job in jobs]
        self.share = [0.0] * len(jobs)  # of each job, done
        self.spent = [0.0] * len(jobs)
        self.began = time.monotonic()
        self._shown = (0.0, self.began)  # share and time of the last line
        shape = "{desc} |{bar}| {percentage:3.0f}% {elapsed}{postfix}"
        self.bar = None
        if mode == "bar":
            try:
                self.bar = tqdm(total=1.0, bar_format=shape)
            except (ValueError, TypeError):  # a TQDM_* variable that tqdm can't read
                self.mode = "lines"

    def tick(self, number: int, tick: Tick) -> None:
        """Note how far the job of this number is, and show it."""
        plan, seeds = self.jobs[number].plan, self.jobs[number].seeds
        self.share[number] = tick.count / plan.length
        self.spent[number] = tick.spent
        unit = "step" if plan.family == "DQN" else "iteration"
        where = (
            f"{plan.env} {plan.name} · T{tick.task} · {unit} {tick.count}/{plan.length}"
            f" · {named(seeds)}"
        )
        work = zip(self.expected, self.share, strict=True)
        done = sum(seconds * share for seconds, share in work) / sum(self.expected)
        all_done = min(self.share) == 1.0
        now, (shown, last) = time.monotonic(), self._shown
        if self.bar is not None:
            self.bar.set_description_str(where, refresh=False)
            if now >= last + _REFRESH or all_done:
                self._shown = done, now
                self.bar.set_postfix_str(f"{_clock(self.to_go())} to go", refresh=False)
            with suppress(*GONE):
                self.bar.update(done - self.bar.n)
        elif self.mode == "lines":
            due = done >= shown + _LINE_EVERY or now >= last + _SILENCE
            if due or tick.count == plan.length:
                self._shown = done, now
                left = f", {_clock(self.to_go())} to go" * (not all_done)
                say(f"{where} · {done:4.0%} · {_clock(now - self.began)}{left}")

    def to_go(self) -> float:
        """Seconds until the last job ends.

        The expected rest of each job, times the ratio of measured to expected time of
        jobs of its kind (environment and family), or of all jobs before one has begun.
        """
        spent, expected = {"": _PRIOR}, {"": _PRIOR}
        kinds = [f"{job.plan.env} {job.plan.family}" for job in self.jobs]
        for number, name in enumerate(kinds):
            begun = [name, ""] if self.spent[number] else []
            for kind in begun:
                seconds = self.expected[number] * self.share[number]
                spent[kind] = spent.get(kind, _PRIOR) + self.spent[number]
                expected[kind] = expected.get(kind, _PRIOR) + seconds
        left = []
        for number, name in enumerate(kinds):
            kind = name if name in spent else ""
            rest = self.expected[number] * (1.0 - self.share[number])
            left.append(rest * spent[kind] / expected[kind])
        return makespan(left, self.workers)

    def close(self) -> None:
        """Leave the terminal tidy."""
        if self.bar is not None:
            with suppress(*GONE):
                self.bar.close()


def _clock(seconds: float) -> str:
    return tqdm.format_interval(seconds)
