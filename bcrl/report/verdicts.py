"""How a claim is judged: an estimate, its interval, and what would confirm it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bcrl.report.notes import listed
from bcrl.report.statistics import (
    Interval,
    Statistic,
    bootstrap,
    bootstrap_difference,
    row_mean,
    share_difference_interval,
    share_interval,
)
from bcrl.report.tables import estimate
from bcrl.report.variants import Variant

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
    "= 0". The first four are judged by the whole interval; "= 0" is a statement about
    every single seed and is judged by the count.
    """

    statement: str
    quantity: str
    expect: str
    needs: tuple[str, ...]
    measure: Callable[..., Measured]

    def row(self, methods: Mapping[str, Variant]) -> list[str]:
        """Statement, quantity, expectation, estimate, seeds, verdict: a table row."""
        absent = [name for name in self.needs if name not in methods]
        used = [methods[name] for name in self.needs if name in methods]
        counts = [len(variant.seeds) for variant in used]
        seeds = " / ".join(map(str, dict.fromkeys(counts))) or "0"
        cells = [self.statement, self.quantity, self.expect]
        if absent:
            return [*cells, "–", seeds, f"no runs of {listed(absent)}"]
        try:
            measured = self.measure(*used)
        except NotMeasurable as reason:
            return [*cells, "–", seeds, f"not measurable: {reason}"]
        shown = estimate(measured.value, measured.interval) + measured.detail
        return [*cells, shown, seeds, judge(measured, self.expect, min(counts))]


def judge(measured: Measured, expect: str, seeds: int) -> str:
    """`holds`, `does not hold` or `undecided`, with the reason for no verdict."""
    if not np.isfinite(measured.value):
        return "undecided (non-finite values)"
    if seeds < FEWEST_SEEDS:
        return f"undecided (fewer than {FEWEST_SEEDS} seeds)"
    low, high = measured.interval
    if expect == "= 0":
        return "holds" if measured.value == 0 else "does not hold"
    threshold = 0.5 if expect == "> ½" else 0.0
    if expect.startswith(">"):
        holds, fails = low > threshold, high <= threshold
    else:
        strict = expect.startswith("<")
        holds = high < threshold if strict else high <= threshold
        fails = low >= threshold if strict else low > threshold
    return "holds" if holds else "does not hold" if fails else "undecided"


def within(values: NDArray[np.float64], detail: str = "") -> Measured:
    """Mean of (S,) values of the same seeds, such as changes within a run."""
    return Measured(float(values.mean()), bootstrap(values), detail)


def between(
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    statistic: Statistic = row_mean,
) -> Measured:
    """statistic(first) − statistic(second) of two methods' seeds."""
    value = float(statistic(first[None])[0] - statistic(second[None])[0])
    return Measured(value, bootstrap_difference(first, second, statistic))


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


def first_of(variant: Variant, stage: int) -> int:
    """Row of a stage's first iteration; NotMeasurable if there is no such stage."""
    return int(_rows(variant, stage)[0])


def last_of(variant: Variant, stage: int) -> int:
    """Row of a stage's last iteration; NotMeasurable if there is no such stage."""
    return int(_rows(variant, stage)[-1])


def _rows(variant: Variant, stage: int) -> NDArray[np.intp]:
    rows = np.flatnonzero(variant.stage == stage)
    if not len(rows):
        raise NotMeasurable(f"{variant.name} has no stage {stage}")
    return rows
