"""Aggregates over seeds: the long-form CSV and the tables at the end of training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bcrl.report.seedfiles import INDEX
from bcrl.report.statistics import (
    Interval,
    bootstrap,
    interquartile_mean,
    mean,
    share_interval,
    standard_error,
)
from bcrl.report.variants import Runs, Variant

_SUMMARY = ("metric", "seeds", "mean", "standard_error")
AGGREGATE_COLUMNS = {
    family: ("scale", "env", "variant", *index, *_SUMMARY)
    for family, index in INDEX.items()
}


def aggregate(runs: Runs, family: str = "FQI") -> pd.DataFrame:
    """Mean and standard error over seeds of every metric at every evaluation.

    One row per (variant, iteration or step, metric), tagged variants included; columns
    AGGREGATE_COLUMNS[family]. A mean over a non-finite value is empty, as is the
    standard error (ddof = 1) of a single seed.
    """
    columns = AGGREGATE_COLUMNS[family]
    *_, counter = INDEX[family]
    blocks = []
    for variant in runs.variants:
        if variant.family != family:
            continue
        for metric, values in variant.metrics.items():
            block = {
                "scale": runs.scale,
                "env": variant.env,
                "variant": variant.name,
                "stage": variant.stage,
                "task": variant.task,
                counter: variant.index,
                "metric": metric,
                "seeds": len(variant.seeds),
                "mean": mean(values),
                "standard_error": standard_error(values, ddof=1),
            }
            blocks.append(pd.DataFrame(block, columns=columns))
    return pd.concat(blocks, ignore_index=True)


def number(value: float) -> str:
    """Four significant digits, a real minus sign, a dash for nan."""
    if not np.isfinite(value):
        return "–"
    return f"{value:#.4g}".rstrip(".").replace("-", "−")


def estimate(value: float, interval: Interval) -> str:
    """`0.12 [0.10, 0.14]`, without the brackets if there is no interval."""
    if not np.isfinite(interval).all():
        return number(value)
    return f"{number(value)} [{number(interval.low)}, {number(interval.high)}]"


class Table(NamedTuple):
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
    parts: Sequence[str | Table]

    def __str__(self) -> str:
        return "\n".join([f"## {self.title}\n", *map(str, self.parts)])


def mean_cell(values: NDArray[np.float64]) -> str:
    """Mean of (S,) values over seeds with its interval."""
    return estimate(float(values.mean()), bootstrap(values))


def _share_cell(values: NDArray[np.float64]) -> str:
    hits = int((values > 0).sum())
    return f"{hits}/{len(values)} {_bracket(share_interval(hits, len(values)))}"


def _bracket(interval: Interval) -> str:
    return f"[{number(interval.low)}, {number(interval.high)}]"


def final_table(methods: Mapping[str, Variant]) -> Table:
    """Every metric after the last iteration: mean with interval, interquartile mean."""
    metrics = [m for m in ("q_error", "q_error_start", "return") if _all(methods, m)]
    header = ["method", "seeds", *metrics, *(f"{m}, IQM" for m in metrics)]
    solved = _all(methods, "solved")
    rows = []
    for name, variant in methods.items():
        last = {m: variant.metrics[m][:, -1] for m in metrics}
        row = [name, str(len(variant.seeds)), *map(mean_cell, last.values())]
        row += [number(interquartile_mean(values)) for values in last.values()]
        if solved:
            row.append(_share_cell(variant.metrics["solved"][:, -1]))
        rows.append(row)
    return Table([*header, "seeds solving the target"] if solved else header, rows)


def stage_table(methods: Mapping[str, Variant], metric: str) -> Table:
    """The mean of `metric` over seeds at the end of every stage, with its task."""
    longest = max(methods.values(), key=lambda v: len(v.stage))
    stages = np.unique(longest.stage)
    rows = []
    for name, variant in methods.items():
        row = [name]
        for stage in stages:
            at = np.flatnonzero(variant.stage == stage)
            values = variant.metrics[metric][:, at[-1]] if len(at) else None
            row.append("–" if values is None else number(float(values.mean())))
        rows.append(row)
    return Table(["method", *(f"stage {stage}" for stage in stages)], rows)


def _all(methods: Mapping[str, Variant], metric: str) -> bool:
    return all(metric in variant.metrics for variant in methods.values())
