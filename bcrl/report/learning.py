"""Learning curves of any environment: each metric of each method, with intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bcrl.common.divergence import diverging
from bcrl.report import style
from bcrl.report.figures import small_print
from bcrl.report.statistics import bootstrap_curves, mean
from bcrl.report.variants import Runs, Variant

POINTS = 300  # of a curve that are drawn, about
COLUMNS = 3  # panels beside each other
#: What counts a family's rows, as an axis says it.
COUNTED = {"FQI": "iteration", "DQN": "environment steps of all stages"}
#: What an axis says of a metric (docs/metrics.md defines them); others by their names.
LABELS = {
    ("FQI", "return"): "discounted return",
    ("FQI", "q_error"): "error, mean |Q − Q*|",
    ("FQI", "q_error_start"): "error at the start, |Q − V*|",
    ("FQI", "residual_start"): "residual at the start",
    ("FQI", "solved"): "episodes that end at the goal",
    ("DQN", "return"): "return, exploring",
    ("DQN", "discounted_return"): "discounted return, exploring",
    ("DQN", "success_rate"): "success rate, exploring",
    ("DQN", "greedy_return"): "return, greedy",
    ("DQN", "greedy_discounted_return"): "discounted return, greedy",
    ("DQN", "greedy_success_rate"): "success rate, greedy",
    ("DQN", "q_mean"): "value at the start, max Q",
}


def label(family: str, metric: str) -> str:
    """A metric in words."""
    return LABELS.get((family, metric), metric.replace("_", " "))


@dataclass(frozen=True)
class Curve:
    """A metric of a variant over (P,) of its evaluations: mean and 95 % interval.

    `rows` are the evaluations' places in the variant's arrays.
    """

    variant: Variant
    metric: str
    rows: NDArray[np.intp]
    mean: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @property
    def x(self) -> NDArray[np.int64]:
        """Iterations or environment steps, (P,)."""
        return self.variant.index[self.rows]

    @property
    def values(self) -> NDArray[np.float64]:
        """Every seed's values, (S, P)."""
        return self.variant.metrics[self.metric][:, self.rows]


def curve(variant: Variant, metric: str) -> Curve:
    """A metric's curve; bootstrap over seeds, as of all means in the report."""
    rows = _shown(variant)
    values = variant.metrics[metric][:, rows]
    return Curve(variant, metric, rows, mean(values), *bootstrap_curves(values))


def _shown(variant: Variant) -> NDArray[np.intp]:
    """Evenly spread rows, POINTS at most, and the first and last of each stage."""
    n = len(variant.stage)
    spread = np.linspace(0, n - 1, min(n, POINTS)).round().astype(np.intp)
    ends = np.flatnonzero(np.diff(variant.stage))
    return np.unique(np.concatenate([spread, ends, ends + 1]))


def metrics_of(methods: Mapping[str, Variant]) -> list[str]:
    """The metrics that a variant has any finite value of, in the CSVs' order."""
    return list(
        dict.fromkeys(
            name
            for variant in methods.values()
            for name, values in variant.metrics.items()
            if np.isfinite(values).any()
        )
    )


def shared_spans(methods: Mapping[str, Variant]) -> list[style.Span]:
    """The tasks' extents, if the variants with several tasks agree on them.

    Others are in the last task throughout.
    """
    courses = [v for v in methods.values() if len(np.unique(v.task)) > 1]
    spans = [style.task_spans(v) for v in courses or methods.values()]
    return spans[0] if all(each == spans[0] for each in spans) else []


def figure_curves(runs: Runs, env: str, family: str, tag: str | None = None) -> Figure:
    """A panel a metric: mean and 95 % interval of every method, tasks shaded."""
    methods = runs.tagged(env, family, tag)
    metrics, spans = metrics_of(methods), shared_spans(methods)
    columns = min(COLUMNS, len(metrics))
    rows = math.ceil(len(metrics) / columns)
    width = max(0.6, columns / 2) * style.WIDTH
    figure = Figure(figsize=(width, 2.5 * rows + 0.7))
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes, metric in zip(panels, metrics, strict=False):
        if spans:
            style.shade_tasks(axes, spans)
        far, within = [], []
        for name, variant in methods.items():
            if metric not in variant.metrics:
                continue
            found = curve(variant, metric)
            style.band(axes, found.x, found.mean, found.low, found.high, name)
            if metric in diverging(variant.metrics):
                far.append(name)
            else:
                within += [found.mean, found.low, found.high]
        style.cut(axes, far, within)
        axes.set_xlabel(COUNTED[family])
        axes.set_ylabel(label(family, metric))
        axes.margins(x=0.0)
    for axes in panels[len(metrics) :]:
        axes.set_axis_off()
    style.legend(figure, methods)
    what = "mean over seeds, bootstrapped 95 % interval"
    style.footer(figure, small_print(runs, methods, what, width))
    return figure
