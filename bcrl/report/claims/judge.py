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
from bcrl.report.variants import Methods

#: Below this a percentile bootstrap is far too narrow: no verdict is given.
FEWEST_SEEDS = 5


class NotMeasurable(Exception):
    """The runs lack what a claim is about, such as a stage; the message says what."""


@dataclass(frozen=True)
class Measured:
    """An estimate with its interval; `detail` is printed after it."""

    value: float
    interval: Interval
    detail: str = ""


@dataclass(frozen=True)
class Claim:
    """One sentence of the paper and the quantity that decides it.

    `expect` is what the claim says of the quantity: "< 0", "> 0", "≤ 0", "> ½" or
    "= 0". For the first four the whole interval decides; "= 0" is a statement about
    every single seed, so that the count decides. `measure` takes the variants of the
    methods that the claim `needs`.
    """

    statement: str
    quantity: str
    expect: str
    needs: tuple[str, ...]
    measure: Callable[..., Measured]

    def row(self, methods: Methods) -> list[str]:
        """Statement, quantity, expectation, estimate, seeds, verdict: a table row."""
        absent = [name for name in self.needs if name not in methods]
        used = [methods[name] for name in self.needs if name in methods]
        counts = [len(variant.seeds) for variant in used]
        seeds = " / ".join(map(str, dict.fromkeys(counts))) or "0"
        cells = [self.statement, self.quantity, self.expect]
        if absent:
            return [*cells, ABSENT, seeds, f"no runs of {listed(absent)}"]
        try:
            measured = self.measure(*used)
        except NotMeasurable as reason:
            return [*cells, ABSENT, seeds, f"not measurable: {reason}"]
        shown = estimate(measured.value, measured.interval) + measured.detail
        return [*cells, shown, seeds, verdict(measured, self.expect, min(counts))]


def verdict(measured: Measured, expect: str, seeds: int) -> str:
    """`holds`, `does not hold` or `undecided`, with the reason for no verdict."""
    if not np.isfinite(measured.value):
        return "undecided (non-finite values)"
    if seeds < FEWEST_SEEDS:
        return f"undecided (fewer than {FEWEST_SEEDS} seeds)"
    if expect == "= 0":
        return "holds" if measured.value == 0 else "does not hold"
    low, high = measured.interval
    threshold = 0.5 if expect == "> ½" else 0.0
    if expect.startswith(">"):
        holds, fails = low > threshold, high <= threshold
    elif expect.startswith("<"):
        holds, fails = high < threshold, low >= threshold
    else:
        holds, fails = high <= threshold, low > threshold
    return "holds" if holds else "does not hold" if fails else "undecided"


def within(values: NDArray[np.float64], detail: str = "") -> Measured:
    """Mean of (S,) values of the same seeds, such as changes within a run."""
    return Measured(float(values.mean()), bootstrap(values), detail)


def between(
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    statistic: Callable[..., NDArray[np.float64]] = np.mean,
) -> Measured:
    """statistic(first) − statistic(second) of two methods' seeds."""
    value = float(statistic(first) - statistic(second))
    return Measured(value, bootstrap(first, second, statistic))


def share(hits: NDArray[np.bool_], detail: str = "") -> Measured:
    """Share of seeds, with Wilson's interval."""
    count, n = int(hits.sum()), len(hits)
    shown = f" ({count} of {n} seeds{detail})"
    return Measured(count / n, share_interval(count, n), shown)


def share_difference(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> Measured:
    """Difference of two methods' shares of seeds, with Newcombe's interval."""
    (k1, n1), (k2, n2) = ((int(h.sum()), len(h)) for h in (first, second))
    interval = share_difference_interval(k1, n1, k2, n2)
    return Measured(k1 / n1 - k2 / n2, interval, f" ({k1}/{n1} against {k2}/{n2})")
