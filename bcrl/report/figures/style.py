"""The look that all figures share: colours, type, task bands, legend, saving."""

import itertools
import textwrap
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from bcrl import __version__
from bcrl.common.files import write_atomically
from bcrl.report.variants import Methods, Runs, Variant, env_title, remarks, tags_shown

#: One colour per way of transfer, for FQI and DQN alike: Okabe and Ito's but yellow.
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
_BANDS = ("#EBEBEB", "#F8F8F8")
OPTIMUM = {"color": "black", "linestyle": (0, (4, 2)), "linewidth": 1.0}
SMALL = {"color": "0.35", "textcoords": "offset points"}  # labels beside what they name
EMPTY = {"color": "0.5", "ha": "center", "va": "center"}  # words on empty axes

_DPI = 150
TEXT_WIDTH = 7.2  # inches, a full text width
_NARROW = 0.055  # share of an axis below which neighbouring labels take two rows
_FOOTER_WIDTH = 20  # characters of small print per inch

Span = tuple[str, float, float]  # a task's name, where it begins and ends


def sheet() -> AbstractContextManager[None]:
    """The style, to be in force while a figure is drawn and while it is saved."""
    ours = Path(__file__).with_name("bcrl.mplstyle")
    return matplotlib.style.context(["default", ours])


def colour(method: str) -> str:
    """A method's colour by its prefix: `BC-FQI` and `BC-DQN` look alike."""
    prefix = method if method in COLOURS else method.rpartition("-")[0]
    return COLOURS.get(prefix, COLOURS["PPR"])


def dashed(method: str) -> bool:
    """Whether it is another algorithm than the families': its lines are dashed."""
    return method not in COLOURS and method.rpartition("-")[2] not in ("FQI", "DQN")


def line_of(method: str) -> dict[str, Any]:
    """Colour and dashes of a method's line, for matplotlib."""
    return {"color": colour(method), "linestyle": "--" if dashed(method) else "-"}


def task_spans(variant: Variant) -> list[Span]:
    """Name and extent of a variant's tasks, on the axis of iterations or steps."""
    task, index = variant.task, variant.index
    if variant.family == "DQN":  # a stage begins with a row
        edges = np.append(index, index[-1]).astype(float)
    else:  # and here it ends with one; not every iteration has a row
        edges = np.append(0, index) + 0.5
    spans = itertools.pairwise([0, *np.flatnonzero(np.diff(task)) + 1, len(task)])
    return [(f"T{task[a]}", edges[a].item(), edges[b].item()) for a, b in spans]


def shade_tasks(axes: Axes, spans: Sequence[Span]) -> None:
    """Grey bands, one per task, named above the axes; narrow ones in two rows."""
    first, last = spans[0][1], spans[-1][2]
    axes.set_xlim(first, last)
    axes.xaxis.set_major_locator(MaxNLocator("auto", integer=True, steps=[1, 2, 5, 10]))
    place = {"xycoords": ("data", "axes fraction"), "ha": "center", "va": "bottom"}
    row, previous_narrow = 0, False
    for number, (label, start, end) in enumerate(spans):
        axes.axvspan(start, end, color=_BANDS[number % 2], linewidth=0, zorder=0)
        narrow = (end - start) / (last - first) < _NARROW
        row = 1 - row if narrow and previous_narrow else 0
        previous_narrow = narrow
        middle, shift = ((start + end) / 2, 1.0), (0, 2 + 8 * row)
        axes.annotate(label, middle, shift, **place, fontsize=7, **SMALL)


def cut(axes: Axes, names: Sequence[str], within: Sequence[np.ndarray]) -> None:
    """Let the y-axis show what is `within`, and name the diverging curves."""
    shown = np.concatenate([np.ravel(values) for values in within])
    shown = shown[np.isfinite(shown)]
    if not len(shown):
        return
    low, high = float(shown.min()), float(shown.max())
    room = 0.05 * (high - low) or 0.05 * abs(high) or 0.5
    axes.set_ylim(low - room, high + room)
    text = f"cut: {', '.join(names)} diverge{'s' * (len(names) == 1)}"
    place = {"xycoords": "axes fraction", "ha": "right", "va": "top"}
    axes.annotate(text, (0.99, 0.98), fontsize=6.5, color="0.35", **place)


def legend(figure: Figure, methods: Iterable[str], optimum: bool = False) -> None:
    """One legend for the whole figure, above it."""
    lines = [{"label": name, "linewidth": 2, **line_of(name)} for name in methods]
    if optimum:
        lines.append({"label": "optimum of the target", **OPTIMUM})
    look = {"loc": "outside upper center", "ncols": len(lines), "handlelength": 1.8}
    figure.legend(handles=[Line2D([], [], **line) for line in lines], **look)


def footer(
    figure: Figure, runs: Runs, methods: Methods, what: str, compares: bool = True
) -> Figure:
    """The figure with small print: environment, seeds, `what` is drawn, `remarks`."""
    env, *_ = (v.env for v in methods.values())
    counts = [len(v.seeds) for v in methods.values()]
    n = "–".join(map(str, sorted({min(counts), max(counts)})))
    seeds = f"{n} seed{'s' * (n != '1')}{' per method' * (len(counts) > 1)}"
    parts = [env_title(env), f"scale {runs.scale}", seeds, tags_shown(methods), what]
    lines = [" · ".join(filter(None, parts)), *remarks(runs, methods, compares)]
    limit = int(figure.get_figwidth() * _FOOTER_WIDTH)
    text = "\n".join(part for line in lines for part in textwrap.wrap(line, limit))
    figure.supxlabel(text, x=0.01, ha="left", fontsize=6.5, color="0.35")
    return figure


def colour_bar(axes: Axes, image: Any, shrink: float, aspect: float) -> Any:
    """A thin colour bar beside an image."""
    bar = axes.figure.colorbar(image, ax=axes, shrink=shrink, aspect=aspect, pad=0.03)
    bar.outline.set_linewidth(0.5)
    bar.ax.tick_params(labelsize=6.5, width=0.5, length=2)
    return bar


def save_figure(figure: Figure, folder: Path, name: str, title: str) -> list[Path]:
    """Write `name`.png and `name`.pdf, atomically and without a date inside."""
    software = f"bcrl {__version__}"
    pdf = {"Title": title, "Creator": software, "CreationDate": None}
    files = []
    for kind, about in (("png", {"Title": title, "Software": software}), ("pdf", pdf)):
        write = partial(figure.savefig, format=kind, dpi=_DPI, metadata=about)
        files.append(write_atomically(folder / f"{name}.{kind}", write))
    return files
