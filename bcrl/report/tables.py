"""Tables of text, cells with intervals, and the long-form aggregate over seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bcrl.report.statistics import Interval, bootstrap, standard_error
from bcrl.report.variants import Methods, Runs, Variant
from bcrl.results.layout import INDEX

ABSENT = "–"  # a cell without a value


class TextTable(NamedTuple):
    """Cells of text; as a string it is Markdown, with bars inside cells escaped."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    def __str__(self) -> str:
        def line(cells: Sequence[str]) -> str:
            return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

        rule = "|" + "---|" * len(self.header)
        return "\n".join([line(self.header), rule, *map(line, self.rows)]) + "\n"


class Section(NamedTuple):
    """Paragraphs and tables below a title; as a string it is Markdown."""

    title: str
    parts: Sequence[str | TextTable]

    def __str__(self) -> str:
        return "\n".join([f"## {self.title}\n", *map(str, self.parts)])


def by_method(
    methods: Methods, columns: Mapping[str, Callable[[Variant], str]]
) -> TextTable:
    """One row per method: its variant's name, then the cell of every column."""
    rows = [[v.name, *(cell(v) for cell in columns.values())] for v in methods.values()]
    return TextTable(["method", *columns], rows)


def number(value: float) -> str:
    """Four significant digits, a real minus sign, a dash for nan."""
    if not np.isfinite(value):
        return ABSENT
    return f"{value:#.4g}".rstrip(".").replace("-", "−")


def estimate(value: float, interval: Interval) -> str:
    """`0.12 [0.10, 0.14]`, without the brackets if there is no interval."""
    if not np.isfinite(interval).all():
        return number(value)
    return f"{number(value)} [{number(interval.low)}, {number(interval.high)}]"


def mean_cell(values: NDArray[np.float64] | None) -> str:
    """Mean of (S,) values over seeds with its interval; a dash if there are none."""
    if values is None:
        return ABSENT
    return estimate(float(values.mean()), bootstrap(values))


def duration(seconds: float) -> str:
    """`1.5 h`, `12 s`."""
    return f"{seconds / 3600:.1f} h" if seconds >= 3600 else f"{seconds:.0f} s"


def seeds_cell(variant: Variant) -> str:
    """`100`, or `97 (3 failed)` if some diverged."""
    failed = f" ({len(variant.failed)} failed)" if variant.failed else ""
    return f"{len(variant.seeds)}{failed}"


def aggregate(runs: Runs, family: str = "FQI") -> pd.DataFrame:
    """Mean and standard error over seeds of every metric at every evaluation.

    One row per (variant, iteration or step, metric), tagged variants included. A mean
    over a non-finite value is empty, as is the standard error (ddof = 1) of one seed.
    """
    *_, counter = INDEX[family]
    blocks = [
        pd.DataFrame(
            {
                "scale": runs.scale,
                "env": variant.env,
                "variant": variant.name,
                "stage": variant.stage,
                "task": variant.task,
                counter: variant.index,
                "metric": metric,
                "seeds": len(variant.seeds),
                "mean": values.mean(axis=0),
                "standard_error": standard_error(values, ddof=1),
            }
        )
        for variant in runs.variants
        if variant.family == family
        for metric, values in variant.metrics.items()
    ]
    return pd.concat(blocks, ignore_index=True)
