"""Figures of the suite: finals by scenario, and the matrices of transfer."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bcrl.report.figures import layout, style
from research.misleading_measures import MARGIN
from research.misleading_tasks import METHODS

_COLOURS = matplotlib.colormaps["cividis"]  # its lightness rises: it serves in grey
_LIMIT = 100.0  # % of plain's gain, from where on colours are the same
_ROW = 0.36  # inches per scenario
_FAR = 200.0  # % of plain's gain, where a panel ends at most


def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as PNG and PDF."""
    with style.sheet():
        return layout.save_figure(figure, folder, name, "Negative transfer")


def figure_finals(table: pd.DataFrame) -> Figure:
    """Final minus plain's by scenario and method, with 95 % intervals, per environment.

    The lines stand at 0 and at the margin of the verdict.
    """
    methods = [m for m in METHODS if m in set(table.method) - {"plain"}]
    looks = style.lines_of(methods)
    with style.sheet():
        envs = [*dict.fromkeys(table.env)]
        rows = (len(envs) + 1) // 2
        most = max(table[table.env == env].scenario.nunique() for env in envs)
        figure = Figure(figsize=(layout.TEXT, rows * (most * _ROW + 0.5)))
        grid = figure.subplots(rows, min(2, len(envs)), squeeze=False)
        for axes in grid.flat[len(envs) :]:
            axes.set_axis_off()
        for env, axes in zip(envs, grid.flat, strict=False):
            _draw_finals(axes, table[table.env == env], methods, looks)
            axes.set_title(env.replace("_", " "))
        layout.legend(
            figure, [(m, {**look, "linestyle": ""}) for m, look in looks.items()]
        )
        figure.set_label(
            "Final return minus plain's, % of plain's gain; bars: 95 % interval; "
            f"what lies beyond {_FAR:.0f} stands at the edge"
        )
    return figure


def _draw_finals(
    axes: Axes, table: pd.DataFrame, methods: list[str], looks: Mapping[str, style.Line]
) -> None:
    scenarios = [*dict.fromkeys(table.scenario)]
    for method in methods:
        own = table[table.method == method]
        shown = [
            m
            for m in methods
            if m in set(table[table.scenario.isin(own.scenario)].method)
        ]
        if not len(own):
            continue
        spread = 0.76 * (shown.index(method) + 0.5) / len(shown) - 0.38
        y = np.array([scenarios.index(x) for x in own.scenario]) + spread
        columns = (100 * own[c] for c in ("final", "final_low", "final_high"))
        x, low, high = (values.clip(-_FAR, _FAR) for values in columns)
        error = np.maximum(0.0, np.nan_to_num(np.stack([x - low, high - x])))
        look = {**looks[method], "linestyle": "", "elinewidth": 0.8}
        axes.errorbar(x, y, xerr=error, **look)
    for place in range(0, len(scenarios), 2):
        axes.axhspan(place - 0.5, place + 0.5, color="#F3F3F3", linewidth=0, zorder=0)
    axes.axvline(0.0, color="black", linewidth=0.7, zorder=1)
    axes.axvline(-100 * MARGIN, color="black", linewidth=0.7, linestyle=":", zorder=1)
    axes.set_yticks(range(len(scenarios)), scenarios)
    axes.set_ylim(len(scenarios) - 0.5, -0.5)
    axes.set_xlabel("final − plain's, % of plain's gain")


def figure_matrix(gains: Mapping[str, Mapping[str, pd.DataFrame]]) -> Figure:
    """Area gained over plain by source task (row) and target task (column)."""
    with style.sheet():
        figure = Figure(figsize=(layout.TEXT, 3.0 * len(gains)))
        grid = figure.subplots(len(gains), 2, squeeze=False)
        for (env, panels), axes_of_env in zip(gains.items(), grid, strict=True):
            for (method, cells), axes in zip(panels.items(), axes_of_env, strict=True):
                image = _draw_cells(axes, 100 * cells)
                axes.set_title(f"{env}: {method}")
            bar = figure.colorbar(image, ax=list(axes_of_env), aspect=25, pad=0.02)
            bar.set_label("area − plain's, % of plain's gain")
        figure.set_label(
            "Area gained over plain on the same target, % of plain's gain; diagonal: B"
        )
    return figure


def _draw_cells(axes: Axes, cells: pd.DataFrame) -> matplotlib.image.AxesImage:
    values, names = cells.to_numpy(), [*cells.columns]
    image = axes.imshow(values, cmap=_COLOURS, vmin=-_LIMIT, vmax=_LIMIT, aspect="auto")
    for y, x in np.ndindex(values.shape):
        text = f"{round(float(values[y, x]))}" if np.isfinite(values[y, x]) else "–"
        dark = values[y, x] < 0.2 * _LIMIT
        look: dict[str, Any] = {
            "ha": "center",
            "va": "center",
            "fontsize": style.LABEL,
        }
        colour = "white" if dark else "black"
        axes.text(x, y, text.replace("-", "−"), color=colour, **look)
    axes.set_xticks(range(len(names)), names, rotation=30, ha="right")
    axes.set_yticks(range(len(names)), names)
    axes.set(xlabel="target", ylabel="source")
    place: Any = axes.get_subplotspec()
    if not place.is_first_col():  # environments differ in their tasks
        axes.set(ylabel="", yticklabels=[])
    return image
