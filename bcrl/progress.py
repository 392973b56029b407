"""How far a run is: a bar on a terminal, else a line now and then."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

from tqdm import tqdm

LINE_EVERY = 0.1  # share of a run between two lines, where no stage ends


@dataclass(frozen=True)
class Tick:
    """How far a group of seeds is."""

    seeds: tuple[int, ...]
    task: int
    count: int  # iterations or steps done
    last_of_stage: bool


class Progress:
    """Shows ticks of one run; `mode` is bar, lines, none or auto."""

    def __init__(
        self, name: str, seeds: Sequence[int], length: int, unit: str, mode: str
    ) -> None:
        if mode == "auto":
            mode = "bar" if sys.stderr.isatty() else "lines"
        self.name, self.length, self.unit, self.mode = name, length, unit, mode
        self.done, self.total = 0, len(seeds) * length
        self._shown = 0.0
        self._counts: dict[tuple[int, ...], int] = {}
        self.began = time.monotonic()
        shape = "{desc} |{bar}| {percentage:3.0f}% {elapsed}, {remaining} to go"
        self.bar = (
            tqdm(total=self.total, desc=name, bar_format=shape, leave=True)
            if mode == "bar"
            else None
        )

    def tick(self, tick: Tick) -> None:
        """Count what a group has done since its last tick."""
        new = len(tick.seeds) * (tick.count - self._counts.get(tick.seeds, 0))
        self._counts[tick.seeds] = tick.count
        self.done += new
        where = (
            f"{self.name} · T{tick.task} · {self.unit} {tick.count}/{self.length}"
            f" · {_named(tick.seeds)}"
        )
        if self.bar is not None:
            self.bar.set_description_str(where, refresh=False)
            self.bar.update(new)
        elif self.mode == "lines" and new:
            share = self.done / self.total
            if tick.last_of_stage or share >= self._shown + LINE_EVERY:
                self._shown = share
                spent = time.monotonic() - self.began
                left = f", {spent / share - spent:.0f} s to go" * (share >= LINE_EVERY)
                line = f"{where} · {share:4.0%} · {spent:.0f} s{left}"
                print(line, file=sys.stderr, flush=True)

    def close(self) -> None:
        """Leave the terminal tidy."""
        if self.bar is not None:
            self.bar.close()


def _named(seeds: Sequence[int]) -> str:
    first, last = seeds[0], seeds[-1]
    if last - first + 1 == len(seeds) > 1:
        return f"seeds {first}–{last}"
    return f"seed{'s' * (len(seeds) > 1)} " + ", ".join(map(str, seeds))
