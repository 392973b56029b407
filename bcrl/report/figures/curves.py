"""Learning curves of any variants; Figures 1, 2 and 5 of the paper are such."""

import itertools
import math
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bcrl.report.figures import layout, style
from bcrl.report.figures.layout import TEXT
from bcrl.report.variants import Methods, Runs, Variant, listed
from bcrl.results.statistics import bootstrap_curves

_LABEL_WIDTH = 26  # characters in a line of a y-axis' label
POINTS = 300  # of a curve that are drawn, about
COUNTED = {"FQI": "iteration", "DQN": "environment steps"}  # on axes
BAND = "mean over seeds, band: 95 % bootstrap interval"
_LABELS = yaml.safe_load(Path(__file__).with_name("labels.yaml").read_text("utf-8"))


def label(family: str, metric: str) -> str:
    """A metric in words."""
    return _LABELS[family].get(metric, metric.replace("_", " "))


def _wrapped(text: str) -> str:
    """A y-axis' label in lines of about the same length."""
    lines = math.ceil(len(text) / _LABEL_WIDTH)
    return textwrap.fill(text, len(text) // lines + 4)


def optimum_of(methods: Methods) -> float | None:
    """The target's optimum if the methods are of one environment and agree on it."""
    found = {(v.env, v.optimum) for v in methods.values()}
    return found.pop()[1] if len(found) == 1 else None


def all_rows(variant: Variant) -> np.ndarray:
    """All rows, (I,)."""
    return np.arange(len(variant.stage))


def spread_rows(variant: Variant) -> np.ndarray:
    """Evenly spread rows, POINTS at most, and the first and last of each stage."""
    n = len(variant.stage)
    spread = np.linspace(0, n - 1, min(n, POINTS)).round().astype(np.intp)
    ends = np.flatnonzero(np.diff(variant.stage))
    return np.unique(np.concatenate([spread, ends, ends + 1]))


def target_rows(variant: Variant) -> np.ndarray:
    """Evenly spread rows of the target task."""
    return np.intersect1d(spread_rows(variant), variant.target_rows)


def draw_metric(
    axes: Axes,
    methods: Methods,
    metric: str,
    rows: Callable[[Variant], np.ndarray] = spread_rows,
    lines: Mapping[str, style.Line] | None = None,
    single: bool = False,
) -> None:
    """Every method's mean over seeds with its 95 % interval, or with all seeds if
    `single`, at some `rows`. `lines`: other looks. Diverging curves are cut off."""
    found, drawn = lines or style.lines_of(methods), {}
    shown = {name: v for name, v in methods.items() if metric in v.metrics}
    for place, (name, variant) in enumerate(shown.items()):
        at, line = rows(variant), found[name]
        x, values = variant.index[at], variant.metrics[metric][:, at]
        mean, colour = values.mean(axis=0), line["color"]
        if single:
            drawn[name] = values
            axes.plot(x, values.T, linewidth=0.5, alpha=0.4, color=colour, zorder=1.9)
        else:
            drawn[name] = np.stack([mean, *bootstrap_curves(values)])
            axes.fill_between(x, *drawn[name][1:], color=colour, alpha=0.2, linewidth=0)
        marks = style.marked(len(x), place, len(shown))
        axes.plot(x, mean, **line, markevery=marks)
    far = [name for name in drawn if metric in shown[name].far]
    far += style.strays(metric, {n: v for n, v in drawn.items() if n not in far})
    if far and len(far) < len(drawn):
        style.cut(axes, far, [v for name, v in drawn.items() if name not in far])


def metrics_of(methods: Methods) -> list[str]:
    """The metrics that a variant has any finite value of, in the CSVs' order."""
    found = [item for variant in methods.values() for item in variant.metrics.items()]
    return list(dict.fromkeys(name for name, v in found if np.isfinite(v).any()))


def shared_spans(methods: Methods) -> list[style.Span]:
    """The tasks' extents, if the variants with several tasks agree on them."""
    several = [v for v in methods.values() if len(np.unique(v.task)) > 1]
    spans = [style.task_spans(v) for v in several or methods.values()]
    return spans[0] if all(each == spans[0] for each in spans) else []


def common_spans(methods: Methods) -> list[style.Span]:
    """The tasks' extents if there are several and they are those of every variant."""
    first, *others = (style.task_spans(variant) for variant in methods.values())
    return first if len(first) > 1 and all(each == first for each in others) else []


def draw_panels(
    methods: Methods,
    labels: Mapping[str, str],
    width: float,
    spans: Sequence[style.Span],
    **how: Any,
) -> tuple[Figure, list[Axes]]:
    """Panels of `labels`' metrics, `spans` shaded; `how` is for `draw_metric`."""
    figure, found = layout.panels(len(labels), width)
    family = next(variant.family for variant in methods.values())
    for axes, (metric, ylabel) in zip(found, labels.items(), strict=True):
        if spans:
            style.shade_tasks(axes, spans)
        draw_metric(axes, methods, metric, **how)
        axes.set(xlabel=COUNTED[family], ylabel=ylabel)
        if family == "DQN" and not spans:  # the first value may come after many steps
            axes.update_datalim([(0.0, 0.0)], updatey=False)
        axes.margins(x=0.0 if spans else 0.015)
        style.number_axis(axes)
    return figure, found


def draw_metrics(
    methods: Methods,
    metrics: Iterable[str],
    width: float,
    target_only: bool = False,
    lines: Mapping[str, style.Line] | None = None,
) -> tuple[Figure, list[Axes], str]:
    """Panels of any variants of one family, tasks shaded where all variants have them
    at the same time, else with a dotted line at each change of a variant's task, and
    what a caption says of the tasks and of the metrics."""
    family = next(variant.family for variant in methods.values())
    labels = {m: _wrapped(label(family, m)) for m in metrics}
    spans = [] if target_only else common_spans(methods)
    rows = target_rows if target_only else spread_rows
    figure, found = draw_panels(methods, labels, width, spans, rows=rows, lines=lines)
    if target_only:
        told = ", target task only"
    elif spans:
        told = ", grey bands: tasks"
    else:
        told = ", dotted: new task" * _mark_changes(found, methods, lines)
    explored = any("exploring" in text for text in labels.values())
    return figure, found, told + ", exploring: with random actions" * explored


def _mark_changes(
    panels: Iterable[Axes], methods: Methods, lines: Mapping[str, style.Line] | None
) -> bool:
    """Dotted lines of a curve's colour where its task changes; whether any does."""
    looks = lines or style.lines_of(methods)
    changes = {
        (start, looks[name]["color"])
        for name, variant in methods.items()
        for _, start, _ in style.task_spans(variant)[1:]
    }
    for axes, (at, colour) in itertools.product(panels, sorted(changes)):
        axes.axvline(at, color=colour, linestyle=":", linewidth=0.8, zorder=1.5)
    return bool(changes)


def figure_metrics(
    runs: Runs,
    methods: Methods,
    metrics: Sequence[str],
    width: float,
    target_only: bool = False,
    lines: Mapping[str, style.Line] | None = None,
) -> Figure:
    """One panel per metric, with a curve and its interval for each of any variants.
    `lines`: other looks."""
    figure, found, told = draw_metrics(methods, metrics, width, target_only, lines)
    fqi = all(variant.family == "FQI" for variant in methods.values())
    optimum = optimum_of(methods) if fqi and "return" in metrics else None
    if optimum is not None:
        found[metrics.index("return")].axhline(optimum, **style.OPTIMUM)
    known = optimum is not None
    what = BAND + told
    return layout.finish(figure, runs, methods, what, optimum=known, lines=lines)


def figure_curves(
    runs: Runs,
    env: str,
    family: str,
    tag: str | None = None,
    width: float = TEXT,
) -> Figure:
    """One panel per metric: mean and 95 % interval of every method, tasks shaded."""
    methods = runs.tagged(env, family, tag)
    return figure_metrics(runs, methods, metrics_of(methods), width)


def figure_1(runs: Runs, tag: str | None = None, width: float = TEXT) -> Figure:
    """Car on the hill: error and return, every seed and their mean (paper, Fig. 1)."""
    methods = runs.methods("car_on_hill", tag)
    labels = {metric: label("FQI", metric) for metric in ("q_error", "return")}
    spans = shared_spans(methods)
    figure, _ = draw_panels(methods, labels, width, spans, rows=all_rows, single=True)
    what = "bold: mean over seeds, thin: single seeds"
    return layout.finish(figure, runs, methods, what + _whose(methods))


def figure_2(runs: Runs, tag: str | None = None, width: float = TEXT) -> Figure:
    """Maze: the paper's error at s0, the return (paper, Fig. 2) and the exact error.
    The paper's error compares Q(s0, ·) with the *target's* V*(s0) in every stage; the
    exact one averages |Q − Q*| over the states and actions of the current task."""
    methods = runs.methods("maze", tag)
    target = max(int(variant.task.max()) for variant in methods.values())
    labels = {
        "q_error_start": f"error at s$_0$\n(V* of T{target})",
        "return": label("FQI", "return"),
        "q_error": "error in the\ntrained task",
    }
    spans = shared_spans(methods)
    figure, panels = draw_panels(methods, labels, width, spans, rows=all_rows)
    for axes in panels[::2]:
        axes.set_ylim(bottom=0)
    if (optimum := optimum_of(methods)) is not None:
        panels[1].axhline(optimum, **style.OPTIMUM)
    errors = "errors: mean over actions of |Q(s$_0$, a) − V*(s$_0$)|, mean |Q − Q*|"
    what, known = f"{errors}, {BAND}{_whose(methods)}", optimum is not None
    return layout.finish(figure, runs, methods, what, optimum=known)


def figure_5(runs: Runs, tag: str | None = None, width: float = TEXT) -> Figure:
    """Maze: BC-FQI's residual at s0, averaged over actions (paper, Fig. 5)."""
    methods = {"BC-FQI": runs.methods("maze", tag)["BC-FQI"]}
    labels = {"residual_start": r"mean residual at s$_0$"}
    spans = shared_spans(methods)
    figure, (axes,) = draw_panels(methods, labels, width, spans, rows=all_rows)
    axes.axhline(0.0, color="0.6", linewidth=0.6, zorder=1.9)
    what = f"residual averaged over actions, {BAND}"
    return layout.finish(figure, runs, methods, what, compares=False)


def _whose(methods: Methods) -> str:
    """Whose tasks are shaded in the paper's figures, if not all methods'."""
    several = [n for n, v in methods.items() if len(np.unique(v.task)) > 1]
    partly = several and len(several) < len(methods) and shared_spans(methods)
    return f", grey bands: tasks of {listed(several)}" if partly else ""
