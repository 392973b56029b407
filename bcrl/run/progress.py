"""The progress of all jobs and the time to go: a bar, or a line now and then."""

import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from bcrl.common.terminal import GONE, say
from bcrl.run.costs import makespan
from bcrl.run.records import named
from bcrl.run.schedule import Job

_LINE_EVERY = 0.1  # share of the work between two lines, where no job ends
_SILENCE = 30.0  # seconds after which a line is due in any case
_REFRESH = 0.5  # seconds between two states of a bar
_PRIOR = 100.0  # seconds of expected work that count as measured


class Tick(NamedTuple):
    """How far a job is."""

    task: int
    count: int  # iterations or steps done
    spent: float  # seconds since it began


class Progress:
    """Shows the ticks of jobs that `workers` take in order; `mode`: see config.yaml."""

    def __init__(self, jobs: Sequence[Job], workers: int, mode: str) -> None:
        self.jobs, self.workers, self.mode, self.bar = jobs, workers, mode, None
        self.expected = np.array([job.seconds for job in jobs])
        self.share, self.spent = np.zeros((2, len(jobs)))  # of each job, done
        self.began = time.monotonic()
        self._shown = (0.0, self.began)  # share of the work and time, when shown last
        if mode == "bar" or (mode == "auto" and getattr(sys.stderr, "isatty", bool)()):
            shape = "{desc} |{bar}| {percentage:3.0f}% {elapsed}{postfix}"
            self.bar = tqdm(total=1.0, bar_format=shape)

    def tick(self, number: int, tick: Tick) -> None:
        """Note how far the job of this number is, and show it if that is due."""
        plan, seeds = self.jobs[number].plan, self.jobs[number].seeds
        self.share[number], self.spent[number] = tick.count / plan.length, tick.spent
        done = float(self.expected @ self.share / self.expected.sum())
        ended = bool(self.share.min() == 1.0)
        now, (shown, last) = time.monotonic(), self._shown
        due = ended or now >= last + (_SILENCE if self.bar is None else _REFRESH)
        if self.bar is None:
            due |= done >= shown + _LINE_EVERY or tick.count == plan.length
        if not due or self.mode == "none":
            return
        self._shown = done, now
        unit = "step" if plan.family == "DQN" else "iteration"
        where = f"{plan.env} {plan.name} · T{tick.task}"
        where += f" · {unit} {tick.count}/{plan.length} · {named(seeds)}"
        left = f"{tqdm.format_interval(self.to_go())} to go"
        if self.bar is None:
            line = f"{where} · {done:4.0%} · {tqdm.format_interval(now - self.began)}"
            say(line if ended else f"{line}, {left}")
            return
        with suppress(*GONE):
            self.bar.set_description_str(where, refresh=False)
            self.bar.set_postfix_str(left, refresh=False)
            self.bar.update(done - self.bar.n)

    def to_go(self) -> float:
        """Seconds until the last job ends: what is expected, at the pace so far."""
        done = self.expected @ self.share
        pace = (self.spent.sum() + _PRIOR) / (done + _PRIOR)
        return makespan(pace * self.expected * (1.0 - self.share), self.workers)

    def close(self) -> None:
        """Leave the terminal tidy."""
        with suppress(*GONE):
            if self.bar is not None:
                self.bar.close()
