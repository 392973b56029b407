"""Figures of an inspection: residuals by stage, ablations, contribution maps."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import CenteredNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bcrl.inspection.measures import UPTO, WHOLE, WITHOUT
from bcrl.report.figures import layout, style
from bcrl.results.statistics import bootstrap

#: Panels of the figure of stages: title, and column → label.
_SIZES = {"residual_sup": "largest", "residual_l2": "L2", "residual_l1": "L1"}
_PANELS: tuple[tuple[str, Mapping[str, str]], ...] = (
    ("size of the residual", _SIZES),
    (
        "states whose greedy action\nthe residual changes (share)",
        {"greedy_changed": ""},
    ),
    ("error of Q", {"q_error": "|Q − Q*|", "bellman_error": "Bellman error"}),
    ("factor α of the base", {"alpha": ""}),
)
_COLOURS = ("#0072B2", "#D55E00", "#009E73")
_MARKERS = ("o", "s", "^")
_MOST = 11  # maps of stages in a figure; of more, some are left out
_COLUMNS = 4


class Plane(NamedTuple):
    """A grid of states in which two components vary."""

    states: np.ndarray  # (X · Y, d), x-major
    x: np.ndarray  # (X,)
    y: np.ndarray  # (Y,)
    names: tuple[str, str]
    fixed: str  # the values of the others, as text


def _curve(
    axes: Axes, table: pd.DataFrame, column: str, place: int, label: str
) -> None:
    """Mean over seeds by stage, with 95 % intervals if there are several seeds."""
    by_stage = table.groupby("stage")[column]
    mean = by_stage.mean()
    look = {"color": _COLOURS[place], "marker": _MARKERS[place], "markersize": 3.5}
    dashes = ("-", "--", ":")[place]
    axes.plot(mean.index, mean, label=label or None, linestyle=dashes, **look)
    if table.seed.nunique() > 1:
        ends = np.array([bootstrap(x.to_numpy()) for _, x in by_stage])
        axes.fill_between(mean.index, *ends.T, color=look["color"], alpha=0.2, lw=0)


def figure_stages(table: pd.DataFrame, width: float = layout.TEXT) -> Figure:
    """Sizes of the residuals, what they decide, and errors of Q, by stage."""
    shown = []
    for title, columns in _PANELS:
        known = [name for name in columns if table[name].notna().any()]
        same = table.stage.max() == 1 or (table[table.stage > 1].alpha == 1.0).all()
        if known and not (known == ["alpha"] and same):
            shown.append((title, [(name, columns[name]) for name in known]))
    figure, grid = layout.panels(len(shown), width)
    for axes, (title, columns) in zip(grid, shown, strict=True):
        for place, (name, label) in enumerate(columns):
            _curve(axes, table, name, place, label)
        if len(columns) > 1:
            axes.legend(fontsize=style.LABEL)
        values = table[[name for name, _ in columns]].to_numpy()
        if "greedy" not in columns[0][0] and np.nanmin(values) > 0:
            axes.set_yscale("log")
        axes.set_title(title, fontsize=8)
        axes.set_xlabel("stage")
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    return figure


def figure_ablations(table: pd.DataFrame, width: float = layout.TEXT) -> Figure:
    """The target's return and errors without one residual, and after each stage."""
    titles = {
        "discounted_return": "discounted return",
        "solved": "episodes solved (share)",
        "q_error": "mean |Q − Q*|",
        "greedy_changed": "states with another\ngreedy action (share)",
    }
    shown = {k: v for k, v in titles.items() if table[k].notna().any()}
    figure, grid = layout.panels(len(shown), width)
    for axes, (column, title) in zip(grid, shown.items(), strict=True):
        whole = table[table.kind == WHOLE][column].mean()
        axes.axhline(whole, **style.OPTIMUM, label="all residuals")
        for place, (kind, label) in enumerate(
            ((WITHOUT, "without residual t"), (UPTO, "residuals 1 to t only"))
        ):
            if len(own := table[table.kind == kind]):
                _curve(axes, own, column, place, label)
        axes.set_title(title, fontsize=8)
        axes.set_xlabel("t")
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    handles, names = grid[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=len(names))
    return figure


def figure_maps(
    maps: Sequence[np.ndarray], plane: Plane, width: float = layout.TEXT
) -> Figure:
    """What each residual adds to V(s) = max_a Q(s, a) in a plane of states.

    `maps`: (X · Y,) per stage. One colour scale for all residuals, another one for V.
    """
    n = len(maps)
    chosen = np.unique(np.linspace(0, n - 1, min(n, _MOST)).round().astype(int))
    rows = -(-(len(chosen) + 1) // _COLUMNS)
    columns = min(_COLUMNS, len(chosen) + 1)
    figure = Figure(figsize=(width, rows * width / _COLUMNS * 0.95))
    grid = list(figure.subplots(rows, columns, squeeze=False).flat)
    # The first residual is far larger than most others, which would look white.
    limit = sorted(np.quantile(np.abs(maps[t]), 0.99) for t in chosen)[-2:][0] or 1.0
    shape, looks = (len(plane.x), len(plane.y)), {"rasterized": True}
    for axes, t in zip(grid, chosen, strict=False):
        norm = CenteredNorm(halfrange=limit)
        image = axes.pcolormesh(
            plane.x,
            plane.y,
            maps[t].reshape(shape).T,
            cmap="RdBu_r",
            norm=norm,
            **looks,
        )
        axes.set_title(f"residual {t + 1}", fontsize=8)
    style.colour_bar(grid[len(chosen) - 1], image, shrink=0.9, aspect=14)
    last = grid[len(chosen)]
    value = np.sum(maps, axis=0).reshape(shape).T
    image = last.pcolormesh(plane.x, plane.y, value, cmap="viridis", **looks)
    style.colour_bar(last, image, shrink=0.9, aspect=14)
    last.set_title("V, their sum", fontsize=8)
    for place, axes in enumerate(grid):
        axes.set_visible(place <= len(chosen))
        axes.tick_params(labelsize=6)
        if place + columns > len(chosen):
            axes.set_xlabel(plane.names[0], fontsize=style.LABEL)
        if place % columns == 0:
            axes.set_ylabel(plane.names[1], fontsize=style.LABEL)
    if plane.fixed:
        figure.supxlabel(plane.fixed, x=0.01, ha="left", fontsize=7.0, color="0.35")
    return figure
