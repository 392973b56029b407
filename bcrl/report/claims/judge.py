"""How a claim gets its verdict: estimate, interval, and what would confirm it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bcrl.report.notes import listed
from bcrl.report.statistics import (
    Interval,
    bootstrap,
    share_difference_interval,
    share_interval,
)
from bcrl.report.tables import ABSENT, estimate
from bcrl.report.variants import Methods, Variant

#: Below this a percentile bootstrap is far too narrow: no verdict is given.
FEWEST_SEEDS = 5


class NotMeasurable(Exception):
    """The runs lack what a claim is about, such as a stage; the message says what."""


@dataclass(frozen=True)
class Quantity:
    """What is measured of a variant: `of` gives (S,) values, or hits to be counted."""

    words: str
    of: Callable[[Variant], NDArray]
    statistic: Callable[..., NDArray[np.float64]] = np.mean


@dataclass(frozen=True)
class Claim:
    """One sentence of the paper and the quantity that decides it.

    The quantity is that of one method, or its difference between two. `expect` is what
    the claim says of it: "< 0", "> 0", "≤ 0", "> ½" or "= 0". For the first four the
    whole interval decides; "= 0" is a statement about every single seed, so that the
    count decides.
    """

    statement: str
    quantity: Quantity
    expect: str
    methods: tuple[str, ...]

    def row(self, runs: Methods) -> list[str]:
        """Statement, quantity, expectation, estimate, seeds, verdict: a table row."""
        absent = [name for name in self.methods if name not in runs]
        used = [runs[name] for name in self.methods if name in runs]
        counts = [len(variant.seeds) for variant in used]
        seeds = " / ".join(map(str, dict.fromkeys(counts))) or "0"
        words = f"{self.quantity.words}: {' − '.join(self.methods)}"
        cells = [self.statement, words, self.expect]
        if absent:
            return [*cells, ABSENT, seeds, f"no runs of {listed(absent)}"]
        try:
            value, interval, detail = _measured(self.quantity, used)
        except NotMeasurable as reason:
            return [*cells, ABSENT, seeds, f"not measurable: {reason}"]
        shown = estimate(value, interval) + detail
        return [
            *cells,
            shown,
            seeds,
            verdict(value, interval, self.expect, min(counts)),
        ]


def _measured(
    quantity: Quantity, variants: list[Variant]
) -> tuple[float, Interval, str]:
    """An estimate, its interval, and the counts of seeds if it is of shares."""
    values = [quantity.of(variant) for variant in variants]
    first, *rest = (float(quantity.statistic(each)) for each in values)
    value = first - rest[0] if rest else first
    if values[0].dtype != bool:
        return value, bootstrap(*values, statistic=quantity.statistic), ""
    (hits, n), *others = counts = [(int(v.sum()), len(v)) for v in values]
    if others:
        shown = " against ".join(f"{k}/{n}" for k, n in counts)
        return value, share_difference_interval(hits, n, *others[0]), f" ({shown})"
    return value, share_interval(hits, n), f" ({hits} of {n} seeds)"


def verdict(value: float, interval: Interval, expect: str, seeds: int) -> str:
    """`holds`, `does not hold` or `undecided`, with the reason for no verdict."""
    if not np.isfinite(value):
        return "undecided (non-finite values)"
    if seeds < FEWEST_SEEDS:
        return f"undecided (fewer than {FEWEST_SEEDS} seeds)"
    low, high = interval
    holds, fails = {
        "= 0": (value == 0, value != 0),
        "> ½": (low > 0.5, high <= 0.5),
        "> 0": (low > 0, high <= 0),
        "< 0": (high < 0, low >= 0),
        "≤ 0": (high <= 0, low > 0),
    }[expect]
    return "holds" if holds else "does not hold" if fails else "undecided"
