"""Learning curves: Figures 1, 2 and 5 of the paper, and those of any environment."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bcrl.report.figures import style
from bcrl.report.variants import Methods, Runs, Variant
from bcrl.results.statistics import bootstrap_curves, standard_error

POINTS = 300  # of a curve that are drawn, about
_COLUMNS = 3  # panels beside each other
COUNTED = {"FQI": "iteration", "DQN": "environment steps of all stages"}  # on axes
_LABELS = yaml.safe_load(Path(__file__).with_name("labels.yaml").read_text("utf-8"))
_SEEDS = {"linewidth": 0.5, "linestyle": (0, (3, 2)), "alpha": 0.45, "zorder": 1.9}
_TWO_ERRORS = "mean ± 2 standard errors over seeds"
Band = tuple[np.ndarray, np.ndarray]


def label(family: str, metric: str) -> str:
    """A metric in words."""
    return _LABELS[family].get(metric, metric.replace("_", " "))


def optimum_of(methods: Methods) -> float | None:
    """The target's optimum if the methods agree on one."""
    optima = {v.optimum for v in methods.values()} - {None}
    return optima.pop() if len(optima) == 1 else None


def two_errors(values: np.ndarray) -> Band:
    """Mean ± 2 standard errors of (S, P) values, (P,) each."""
    centre, half = values.mean(axis=0), 2 * standard_error(values)
    return centre - half, centre + half


def spread_rows(variant: Variant) -> np.ndarray:
    """Evenly spread rows, POINTS at most, and the first and last of each stage."""
    n = len(variant.stage)
    spread = np.linspace(0, n - 1, min(n, POINTS)).round().astype(np.intp)
    ends = np.flatnonzero(np.diff(variant.stage))
    return np.unique(np.concatenate([spread, ends, ends + 1]))


def draw_metric(
    axes: Axes,
    methods: Methods,
    metric: str,
    rows: Callable[[Variant], np.ndarray] | None = None,
    interval: Callable[[np.ndarray], Band] | None = two_errors,
) -> None:
    """Every method's mean over seeds with a band, or with all seeds if no `interval`.
    All rows are drawn unless `rows` chooses some. Diverging curves are cut off."""
    far, within = [], []
    for name, variant in methods.items():
        if metric not in variant.metrics:
            continue
        at, line = rows(variant) if rows else slice(None), style.line_of(name)
        x, values = variant.index[at], variant.metrics[metric][:, at]
        mean, drawn = values.mean(axis=0), [values]
        if interval:
            low, high = interval(values)
            drawn = [mean, low, high]
            fill = {"color": line["color"], "alpha": 0.25, "linewidth": 0}
            axes.fill_between(x, low, high, **fill)
        else:
            axes.plot(x, values.T, **_SEEDS, color=line["color"])
        axes.plot(x, mean, linewidth=1.6 if interval else 2.0, **line)
        if metric in variant.far:
            far.append(name)
        else:
            within += drawn
    if far and within:
        style.cut(axes, far, within)


def metrics_of(methods: Methods) -> list[str]:
    """The metrics that a variant has any finite value of, in the CSVs' order."""
    found = [item for variant in methods.values() for item in variant.metrics.items()]
    return list(dict.fromkeys(name for name, v in found if np.isfinite(v).any()))


def shared_spans(methods: Methods) -> list[style.Span]:
    """The tasks' extents, if the variants with several tasks agree on them."""
    several = [v for v in methods.values() if len(np.unique(v.task)) > 1]
    spans = [style.task_spans(v) for v in several or methods.values()]
    return spans[0] if all(each == spans[0] for each in spans) else []


def _panels(
    methods: Methods, labels: Mapping[str, str], size: tuple[float, float], **how: Any
) -> tuple[Figure, list[Axes]]:
    """Panels of `labels`' metrics, tasks shaded; `how` is for `draw_metric`."""
    figure, n = Figure(figsize=size), len(labels)
    columns, spans = min(_COLUMNS, n), shared_spans(methods)
    grid = figure.subplots(math.ceil(n / columns), columns, squeeze=False)
    for axes in grid.flat[n:]:
        axes.set_axis_off()
    family = next(variant.family for variant in methods.values())
    for axes, (metric, ylabel) in zip(grid.flat, labels.items(), strict=False):
        if spans:
            style.shade_tasks(axes, spans)
        draw_metric(axes, methods, metric, **how)
        axes.set(xlabel=COUNTED[family], ylabel=ylabel)
        axes.margins(x=0.0)
    return figure, list(grid.flat)


def figure_curves(runs: Runs, env: str, family: str, tag: str | None = None) -> Figure:
    """One panel per metric: mean and 95 % interval of every method, tasks shaded."""
    methods = runs.tagged(env, family, tag)
    labels = {metric: label(family, metric) for metric in metrics_of(methods)}
    width = max(0.6, min(_COLUMNS, len(labels)) / 2) * style.TEXT_WIDTH
    size = width, 2.5 * math.ceil(len(labels) / _COLUMNS) + 0.7
    how = {"rows": spread_rows, "interval": bootstrap_curves}
    figure, _ = _panels(methods, labels, size, **how)
    style.legend(figure, methods)
    return style.footer(
        figure, runs, methods, "mean over seeds, bootstrapped 95 % interval"
    )


def figure_1(runs: Runs, tag: str | None = None) -> Figure:
    """Car on the hill: error and return, every seed and their mean (paper, Fig. 1)."""
    methods = runs.methods("car_on_hill", tag)
    labels = {metric: label("FQI", metric) for metric in ("q_error", "return")}
    figure, _ = _panels(methods, labels, (style.TEXT_WIDTH, 3.3), interval=None)
    style.legend(figure, methods)
    return style.footer(
        figure, runs, methods, "bold: mean over seeds, dashed: single seeds"
    )


def figure_2(runs: Runs, tag: str | None = None) -> Figure:
    """Maze: the paper's error at s0, the return (paper, Fig. 2) and the exact error.
    The paper's error compares Q(s0, ·) with the *target's* V*(s0) in every stage; the
    exact one averages |Q − Q*| over the states and actions of the current task."""
    methods = runs.methods("maze", tag)
    target = max(int(variant.task.max()) for variant in methods.values())
    labels = {
        "q_error_start": f"error at the start, V* of T{target}\n"
        r"mean$_a$ |Q(s$_0$, a) − V*(s$_0$)|",
        "return": "discounted return",
        "q_error": "error in the trained task\nmean |Q − Q*|",
    }
    figure, panels = _panels(methods, labels, (1.4 * style.TEXT_WIDTH, 3.2))
    for axes in panels[::2]:
        axes.set_ylim(bottom=0)
    if (optimum := optimum_of(methods)) is not None:
        panels[1].axhline(optimum, **style.OPTIMUM)
    style.legend(figure, methods, optimum=optimum is not None)
    return style.footer(figure, runs, methods, _TWO_ERRORS)


def figure_5(runs: Runs, tag: str | None = None) -> Figure:
    """Maze: BC-FQI's residual at s0, averaged over actions (paper, Fig. 5)."""
    methods = {"BC-FQI": runs.methods("maze", tag)["BC-FQI"]}
    labels = {"residual_start": "residual at the start\n" r"mean$_a$ ϱ$_t$(s$_0$, a)"}
    figure, (axes,) = _panels(methods, labels, (0.75 * style.TEXT_WIDTH, 3.0))
    axes.axhline(0.0, color="0.6", linewidth=0.6, zorder=1.9)
    style.legend(figure, methods)
    return style.footer(figure, runs, methods, _TWO_ERRORS, compares=False)
