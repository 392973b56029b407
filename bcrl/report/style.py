"""The look that all figures share: colours, type, task bands, legend, saving."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from bcrl import __version__
from bcrl.common.files import write_atomically
from bcrl.report.variants import Variant

#: One colour per way of transfer, in every figure and for FQI and DQN alike: Okabe and
#: Ito's palette and a grey. Yellow is left out, it vanishes on white.
COLOURS = {
    "": "#0072B2",  # plain
    "C": "#E69F00",
    "B": "#009E73",
    "BC": "#D55E00",
    "SC": "#56B4E9",
    "SBC": "#CC79A7",
    "RPL": "#000000",
    "PPR": "#8C8C8C",
    "LSPI": "#7A4B1E",  # pretraining only
}
BANDS = ("#EBEBEB", "#F8F8F8")
OPTIMUM = {"color": "black", "linestyle": (0, (4, 2)), "linewidth": 1.0}

DPI = 150
WIDTH = 7.2  # inches, a full text width
NARROW = 0.055  # share of an axis below which neighbouring labels take two rows

RC = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same on every machine
    "font.size": 8.0,
    "axes.labelsize": 8.5,
    "axes.titlesize": 8.5,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.solid_capstyle": "round",
    "figure.constrained_layout.use": True,
    "pdf.fonttype": 42,  # TrueType: text stays text
}


def sheet() -> AbstractContextManager[None]:
    """The style, to be in force while a figure is drawn and while it is saved."""
    defaults = {k: v for k, v in matplotlib.rcParamsDefault.items() if k != "backend"}
    return matplotlib.rc_context({**defaults, **RC})


def colour(method: str) -> str:
    """A method's colour by its prefix: `BC-FQI` and `BC-DQN` look alike."""
    if method in COLOURS:
        return COLOURS[method]
    prefix, dash, _ = method.rpartition("-")
    return COLOURS.get(prefix, COLOURS["PPR"]) if dash else COLOURS[""]


Span = tuple[str, float, float]  # a task's name, where it begins and ends


def dashed(method: str) -> bool:
    """Whether it is another algorithm than the families': its lines are dashed."""
    return method not in COLOURS and method.rpartition("-")[2] not in ("FQI", "DQN")


def stage_spans(variants: Iterable[Variant]) -> list[Span]:
    """Name and extent, on the iteration axis, of every task of the longest variant.

    Of equally long ones it is the one with most tasks, hence one with a curriculum.
    """
    return task_spans(
        max(variants, key=lambda v: (len(v.stage), len(np.unique(v.task))))
    )


def task_spans(variant: Variant) -> list[Span]:
    """Name and extent, on the axis of iterations or steps, of every task of a variant.

    An iteration reaches half a one to either side; steps go on from task to task.
    """
    starts = [0, *(np.flatnonzero(np.diff(variant.task)) + 1), len(variant.task)]
    edges = np.arange(len(variant.task) + 1) + 0.5
    if variant.family == "DQN":
        edges = np.append(variant.index, variant.index[-1])
    return [
        (f"T{variant.task[start]}", float(edges[start]), float(edges[end]))
        for start, end in itertools.pairwise(starts)
    ]


def shade_tasks(axes: Axes, spans: Sequence[Span]) -> None:
    """Grey bands, one per task, named above the axes; narrow ones in two rows."""
    first, last = spans[0][1], spans[-1][2]
    axes.set_xlim(first, last)
    axes.xaxis.set_major_locator(MaxNLocator("auto", integer=True, steps=[1, 2, 5, 10]))
    row, previous_narrow = 0, False
    for number, (label, start, end) in enumerate(spans):
        axes.axvspan(start, end, color=BANDS[number % 2], linewidth=0, zorder=0)
        narrow = (end - start) / (last - first) < NARROW
        row = 1 - row if narrow and previous_narrow else 0
        previous_narrow = narrow
        axes.annotate(
            label,
            ((start + end) / 2, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 2 + 8 * row),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=7,
            color="0.35",
        )


def band(
    axes: Axes,
    x: NDArray[np.int64],
    centre: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    method: str,
) -> None:
    """A mean line with a band around it."""
    axes.fill_between(x, low, high, color=colour(method), alpha=0.25, linewidth=0)
    line = "--" if dashed(method) else "-"
    axes.plot(x, centre, color=colour(method), linewidth=1.6, linestyle=line)


def cut(axes: Axes, names: Sequence[str], within: Sequence[NDArray]) -> None:
    """Let the y-axis show what is `within`, and say whose curves leave it.

    For curves `names` that diverge: they would flatten all others.
    """
    shown = np.concatenate([np.ravel(values) for values in within] or [[]])
    shown = shown[np.isfinite(shown)]
    if not names or not len(shown):
        return
    low, high = float(shown.min()), float(shown.max())
    room = 0.05 * (high - low) or 0.05 * abs(high) or 0.5
    axes.set_ylim(low - room, high + room)
    text = f"cut: {', '.join(names)} diverge{'s' * (len(names) == 1)}"
    place = {"xycoords": "axes fraction", "ha": "right", "va": "top"}
    axes.annotate(text, (0.99, 0.98), fontsize=6.5, color="0.35", **place)


def legend(figure: Figure, methods: Iterable[str], optimum: bool = False) -> None:
    """One legend for the whole figure, above it."""
    handles = [
        Line2D(
            *([], []),
            color=colour(method),
            linestyle="--" if dashed(method) else "-",
            linewidth=2,
            label=method,
        )
        for method in methods
    ]
    if optimum:
        handles.append(Line2D([], [], label="optimum of the target", **OPTIMUM))
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=len(handles),
        handlelength=1.8,
    )


def footer(figure: Figure | SubFigure, lines: Iterable[str]) -> None:
    """Small print under the figure: what is drawn, from how many seeds, what is odd."""
    text = "\n".join(lines)
    figure.supxlabel(text, x=0.01, ha="left", fontsize=6.5, color="0.35")


def save(figure: Figure, folder: Path, name: str, title: str) -> list[Path]:
    """Write `name`.png and `name`.pdf, atomically and without a date inside."""
    software = f"bcrl {__version__}"
    metadata = {
        "png": {"Title": title, "Software": software},
        "pdf": {"Title": title, "Creator": software, "CreationDate": None},
    }
    return [
        write_atomically(
            folder / f"{name}.{kind}",
            lambda handle, kind=kind: figure.savefig(
                handle, format=kind, dpi=DPI, metadata=metadata[kind]
            ),
        )
        for kind in metadata
    ]
