"""Tables of text, cells with intervals, and the long-form aggregate over seeds."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import yaml
from scipy import stats

from bcrl.report.statistics import FEWEST_SEEDS, Interval, bootstrap, standard_error
from bcrl.report.variants import WINDOW, Runs
from bcrl.results.layout import INDEX

ABSENT = "–"  # a cell without a value
_TEXTS = Path(__file__).with_name("templates") / "texts.yaml"
#: Paragraphs of the documents and the page, by name.
TEXTS = {
    name: text.format(fewest=FEWEST_SEEDS, window=WINDOW)
    for name, text in yaml.safe_load(_TEXTS.read_text("utf-8")).items()
}


class TextTable(NamedTuple):
    """Rows from a column's header to its cell; as a string it is Markdown."""

    rows: Sequence[Mapping[str, str]]

    def __str__(self) -> str:
        first, *_ = rows = self.rows
        lines = [[*first], ["---"] * len(first), *(row.values() for row in rows)]
        cells = [[cell.replace("|", "\\|") for cell in line] for line in lines]
        return "".join(f"| {' | '.join(line)} |\n" for line in cells)


class Section(NamedTuple):
    """Paragraphs and tables below a title; as a string it is Markdown."""

    title: str
    parts: Sequence[str | TextTable]

    def __str__(self) -> str:
        return "\n".join([f"## {self.title}\n", *map(str, self.parts)])


def number(value: float) -> str:
    """Four significant digits, a real minus sign, a dash for nan."""
    if not np.isfinite(value):
        return ABSENT
    return f"{value:#.4g}".rstrip(".").replace("-", "−")


def estimate(value: float, interval: Interval) -> str:
    """`0.12 [0.10, 0.14]`, without the brackets if there is no interval."""
    if not np.isfinite(interval).all():
        return number(value)
    return f"{number(value)} [{number(interval[0])}, {number(interval[1])}]"


def mean_cell(values: np.ndarray) -> str:
    """Mean of (S,) values over seeds with its interval."""
    return estimate(values.mean(), bootstrap(values))


def interquartile_mean(values: np.ndarray) -> str:
    """Mean of (S,) values without the lowest and the highest ⌊S/4⌋ of them."""
    return number(stats.trim_mean(values, 0.25))


def duration(seconds: float) -> str:
    """`1.5 h`, `12 s`."""
    return f"{seconds / 3600:.1f} h" if seconds >= 3600 else f"{seconds:.0f} s"


def seeds_cell(complete: int, failed: int) -> str:
    """`100`, or `97 (3 failed)` if some diverged."""
    return f"{complete} ({failed} failed)" if failed else f"{complete}"


def aggregate(runs: Runs, family: str = "FQI") -> pd.DataFrame:
    """Mean and standard error over seeds of every metric at every evaluation. One row
    per (variant, iteration or step, metric), tagged variants included. A mean over a
    non-finite value is empty, as is the standard error (ddof = 1) of one seed."""
    *_, counter = INDEX[family]
    blocks = [
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
        for variant in runs.variants
        if variant.family == family
        for metric, values in variant.metrics.items()
    ]
    return pd.concat(map(pd.DataFrame, blocks), ignore_index=True)
