"""Figures of sweeps: curves coloured by a key's value, final values, heat maps."""

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from bcrl.report.figures import curves, layout, style
from bcrl.report.sweeps import Sweep, is_numeric, sorted_values, text_of
from bcrl.report.variants import Methods, Runs
from bcrl.results.outcomes import WINDOW
from bcrl.results.statistics import bootstrap

_DECADE = 10.0  # numbers that span this factor have a logarithmic axis
_MANY = 200.0  # from this factor on, only powers of ten are named
_NAMED = 6  # values that a legend or an axis lists; of more a scale shows some
_WRITTEN = 8  # columns of a heat map whose cells show their numbers
_COLOURS = matplotlib.colormaps["viridis"]  # its lightness rises: it serves in grey
_LIGHTEST = 0.88  # of these colours, for lines on white
_ENDS = {"FQI": "last iteration", "DQN": f"mean of the last {WINDOW} steps"}


def _by_decades(values: Sequence[Any]) -> bool:
    """Whether an axis of these is logarithmic: positive numbers that span decades."""
    wide = is_numeric(values) and min(values) > 0
    return wide and bool(max(values) >= _DECADE * min(values))


def _mark_decades(axis: Axis, values: Sequence[Any]) -> None:
    """Plain numbers on a logarithmic axis: `1 2 5 10`, or `1 10` if these are many."""
    few = max(values) < _MANY * min(values)
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,)))
    axis.set_major_formatter(lambda x, _: f"{x:.12g}")
    axis.set_minor_formatter(NullFormatter())


def _norm(values: Sequence[Any]) -> Normalize:
    """From values to shares of the colours: by decades, evenly, or by their places."""
    if not is_numeric(values):
        return Normalize(0, max(1, len(values) - 1))
    return (LogNorm if _by_decades(values) else Normalize)(min(values), max(values))


def figure_sweep(
    runs: Runs, sweep: Sweep, metric: str, width: float, target_only: bool = False
) -> Figure:
    """A metric's curves, coloured by the value of the one key that is swept."""
    (key,), values, methods = sweep.keys, sweep.steps(0), sweep.methods
    barred, norm = len(values) > _NAMED and is_numeric(values), _norm(values)
    lines = style.lines_of(methods)
    at = values if is_numeric(values) else range(len(values))
    for line, value in zip(lines.values(), at, strict=True):
        line |= {"color": _COLOURS(_LIGHTEST * float(norm(value))), "linestyle": "-"}
        line |= {"marker": "", "linewidth": 1.1} if barred else {}
    figure, (axes,), told = curves.draw_metrics(
        methods, [metric], width, target_only, lines
    )
    if barred:
        shown = _COLOURS(np.linspace(0, _LIGHTEST, 256))
        scale = ScalarMappable(norm, matplotlib.colors.ListedColormap(shown))
        bar = style.colour_bar(axes, scale, shrink=1.0, aspect=25)
        bar.set_label(key)
        if isinstance(norm, LogNorm):
            _mark_decades(bar.ax.yaxis, values)
    else:
        layout.legend(figure, lines.items(), key)
    what = f"{sweep.label}, colour: {key}, {curves.BAND}{told}"
    return layout.caption(figure, runs, methods, what)


def figure_final(
    runs: Runs, sweeps: Sequence[Sweep], metric: str, width: float
) -> Figure:
    """What the runs end with against the one key that is swept, a line per sweep."""
    figure, (axes,) = layout.panels(1, width)
    (key,), family = sweeps[0].keys, next(iter(sweeps[0].variants.values())).family
    values = sorted_values({value for sweep in sweeps for value in sweep.steps(0)})
    numeric, lines = is_numeric(values), style.lines_of([s.label for s in sweeps])
    for sweep in sweeps:
        steps = sweep.steps(0)
        x = np.array(steps if numeric else [values.index(each) for each in steps])
        ends = [variant.final(metric) for variant in sweep.variants.values()]
        mean = np.array([each.mean() for each in ends])
        low, high = np.transpose([bootstrap(each) for each in ends])
        # Equal values: rounding can put the mean just outside its interval.
        error = np.maximum(0, np.nan_to_num(np.stack([mean - low, high - mean])))
        axes.errorbar(x, mean, error, capsize=2.0, elinewidth=0.8, **lines[sweep.label])
    if numeric and _by_decades(values):
        axes.set_xscale("log")
        _mark_decades(axes.xaxis, values)
    if not numeric or len(values) <= _NAMED:
        axes.minorticks_off()
        axes.set_xticks(values if numeric else range(len(values)))
        axes.set_xticklabels(map(text_of, values))
    axes.set(xlabel=key, ylabel=curves.label(family, metric))
    layout.legend(figure, lines.items())
    methods: Methods = {
        f"{sweep.label} {name}": variant
        for sweep in sweeps
        for name, variant in sweep.methods.items()
    }
    what = f"{_ENDS[family]}, mean over seeds, bars: 95 % bootstrap interval"
    return layout.caption(figure, runs, methods, what)


def figure_map(runs: Runs, sweep: Sweep, metric: str, width: float) -> Figure:
    """What the runs end with, as a colour for each pair of values of two swept keys."""
    columns, rows = sweep.steps(0), sweep.steps(1)
    cells = np.full((len(rows), len(columns)), np.nan)
    for (x, y), variant in sweep.variants.items():
        cells[rows.index(y), columns.index(x)] = variant.final(metric).mean()
    figure, (axes,) = layout.panels(1, width)
    shown = {str(at): np.array([cells[at]]) for at in np.ndindex(cells.shape)}
    far = style.strays(metric, {n: v for n, v in shown.items() if np.isfinite(v).all()})
    within = np.concatenate([v for name, v in shown.items() if name not in far])
    within = within[np.isfinite(within)]
    limits = {"vmin": within.min(), "vmax": within.max()} if len(within) else {}
    image = axes.imshow(cells, cmap=_COLOURS, origin="lower", aspect="auto", **limits)
    if len(columns) <= _WRITTEN:
        _write(axes, cells, image.norm)
    axes.set_xticks(range(len(columns)), map(text_of, columns))
    axes.set_yticks(range(len(rows)), map(text_of, rows))
    axes.set(xlabel=sweep.keys[0], ylabel=sweep.keys[1])
    family = next(iter(sweep.variants.values())).family
    label = curves.label(family, metric)
    if limits:
        style.colour_bar(axes, image, shrink=1.0, aspect=25).set_label(label)
    else:
        axes.set_title(f"{label}: no values")
    what = f"{sweep.label}, {_ENDS[family]}, mean over seeds"
    return layout.caption(figure, runs, sweep.methods, what)


def _write(axes: Axes, cells: np.ndarray, norm: Normalize) -> None:
    """Each cell's number, dark on light and light on dark."""
    for y, x in np.ndindex(cells.shape):
        finite = np.isfinite(cells[y, x])
        dark = finite and norm(cells[y, x]) < 0.6
        text = f"{cells[y, x]:#.3g}".rstrip(".").replace("-", "−") if finite else "–"
        look = {"color": "white" if dark else "black", "fontsize": style.LABEL}
        axes.text(x, y, text, ha="center", va="center", **look)
