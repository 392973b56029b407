"""The look that all figures share: colours, dashes, markers, task bands, cut axes."""

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from bcrl.report.variants import Variant

_DASHED, _DASH_DOT, _DOTTED = (4.0, 1.6), (6.0, 1.5, 1.2, 1.5), (1.2, 1.2)
_LONG_DASHED = (8.0, 2.0)
#: By way of transfer, for FQI and DQN alike: colour, dashes (points; none: solid) and
#: marker. Colours are Okabe and Ito's but yellow; the rest tells them apart in grey.
LOOKS: dict[str, tuple[str, tuple[float, ...], str]] = {
    "": ("#0072B2", _DASHED, "o"),  # plain
    "C": ("#E69F00", _DASH_DOT, "s"),
    "B": ("#009E73", _DOTTED, "^"),
    "BC": ("#D55E00", (), "D"),
    "SC": ("#56B4E9", _LONG_DASHED, "v"),
    "SBC": ("#CC79A7", (), "P"),
    "RPL": ("#000000", _DASH_DOT, "X"),
    "PPR": ("#8C8C8C", _DOTTED, "h"),
    "LSPI": ("#7A4B1E", (), "<"),  # pretraining only
}
_DASHES = ((), _DASHED, _DOTTED, _DASH_DOT, _LONG_DASHED)
_MARKERS = "osD^vPX<>h"
_MARKS = 6  # on a curve, about
_BANDS = ("#EBEBEB", "#F8F8F8")
OPTIMUM = {"color": "black", "linestyle": (0, (4, 2)), "linewidth": 1.0}
SMALL = {"color": "0.35", "textcoords": "offset points"}  # labels beside what they name
EMPTY = {"color": "0.5", "ha": "center", "va": "center"}  # words on empty axes
LABEL = 7.0  # points, of names inside panels
_FAR = 1000.0  # times what the other curves reach: larger values are cut off
_GROW = ("q_error", "q_mean", "loss", "residual")  # metrics that diverge upwards, too

Line = dict[str, Any]  # a line's look, for matplotlib
Span = tuple[str, float, float]  # a task's name, where it begins and ends


def sheet() -> AbstractContextManager[None]:
    """The style, to be in force while a figure is drawn and while it is saved."""
    ours = Path(__file__).with_name("bcrl.mplstyle")
    return matplotlib.style.context(["default", ours])


def _prefix(name: str) -> str:
    """What LOOKS has of a method or a label: `BC` of `BC-FQI@ep100` and of
    `BC-FQI, loss=l1`, `RPL` of `RPL`."""
    method = re.split("[@ ,]", name, maxsplit=1)[0]
    prefix = method if method in LOOKS else method.rpartition("-")[0]
    return prefix if prefix in LOOKS else "PPR"


def colour(method: str) -> str:
    """A method's colour by its prefix: `BC-FQI` and `BC-DQN` look alike."""
    return LOOKS[_prefix(method)][0]


def lines_of(names: Iterable[str]) -> dict[str, Line]:
    """The look of each curve's line. The colour is the method's; where several have it,
    the others have other dashes and hollow markers of other shapes."""
    found, used = {}, Counter[str]()
    for name in names:
        shade, dashes, marker = LOOKS[_prefix(name)]
        place = used[shade]
        used[shade] += 1
        line: Line = {"color": shade, "linewidth": 1.3, "markersize": 3.5}
        if place:
            dashes = _DASHES[(_DASHES.index(dashes) + place) % len(_DASHES)]
            marker = _MARKERS[(_MARKERS.index(marker) + place) % len(_MARKERS)]
            line |= {"markerfacecolor": "white", "markeredgewidth": 0.9}
        line |= {"linestyle": (0, dashes) if dashes else "-", "marker": marker}
        found[name] = line
    return found


def marked(points: int, place: int, curves: int) -> tuple[int, int]:
    """Which of a curve's points have a marker: others than on the other curves."""
    step = max(1, round(points / _MARKS))
    return place * step // max(1, curves), step


def task_spans(variant: Variant) -> list[Span]:
    """Name and extent of a variant's tasks, on the axis of iterations or steps."""
    task, index = variant.task, variant.index
    if variant.family == "DQN":  # a stage begins with a row
        edges = np.append(index, index[-1]).astype(float)
    else:  # and here it ends with one; not every iteration has a row
        between = int(index[1] - index[0]) if len(index) > 1 else 1
        # Another run's stages, from which this one starts, come first.
        begin = max(0, index[0] - between) if variant.stage[0] > 1 else 0
        edges = np.append(begin, index) + 0.5
    spans = itertools.pairwise([0, *np.flatnonzero(np.diff(task)) + 1, len(task)])
    return [(f"T{task[a]}", edges[a].item(), edges[b].item()) for a, b in spans]


def _width(axes: Axes) -> float:
    """About the width of axes, points; the layout decides when all is drawn."""
    return axes.bbox.width / axes.figure.dpi * 72


def shade_tasks(axes: Axes, spans: Sequence[Span]) -> None:
    """Grey bands, one per task, named above the axes in two rows if need be. Names that
    have no room are left out, the target's last."""
    first, last = spans[0][1], spans[-1][2]
    axes.set_xlim(first, last)
    width = _width(axes)
    taken: tuple[list[float], list[float]] = [], []  # middles and half widths, by row
    place = {"xycoords": ("data", "axes fraction"), "ha": "center", "va": "bottom"}
    for number, (_, start, end) in enumerate(spans):
        axes.axvspan(start, end, color=_BANDS[number % 2], linewidth=0, zorder=0)
    for label, start, end in [spans[-1], *spans[:-1]]:
        middle, room = (start + end) / 2, 0.72 * len(label) * LABEL
        at = width * (middle - first) / (last - first)
        free = (r for r in (0, 1) if all(abs(at - m) > room for m in taken[r]))
        if (row := next(free, None)) is not None:
            taken[row].append(at)
            shift = (0, 2 + 8 * row)
            axes.annotate(label, (middle, 1.0), shift, **place, fontsize=LABEL, **SMALL)


def number_axis(axes: Axes) -> None:
    """Whole numbers on the x-axis, with a thin space at the thousands: `40 000`."""
    few = 4 if _width(axes) < 216 else 8
    axes.xaxis.set_major_locator(MaxNLocator(few, integer=True, steps=[1, 2, 5, 10]))
    axes.xaxis.set_major_formatter(lambda x, _: f"{x:,.0f}".replace(",", "\u2009"))


def strays(metric: str, curves: Mapping[str, np.ndarray]) -> list[str]:
    """The few curves that reach so far that all others would look flat: upwards for
    errors and losses, else downwards, so that no success is taken for a divergence."""
    both = metric.startswith(_GROW)
    most = {n: np.nanmax(np.abs(v), initial=0.0) for n, v in curves.items()}
    far = {
        n: most[n] if both else np.nanmax(-v, initial=0.0) for n, v in curves.items()
    }
    ranked = sorted(most, key=lambda name: most[name])
    for place in range((len(ranked) + 1) // 2, len(ranked)):
        if all(0 < _FAR * most[ranked[place - 1]] < far[n] for n in ranked[place:]):
            return ranked[place:]
    return []


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
    axes.annotate(text, (0.99, 0.98), fontsize=LABEL, color="0.35", **place)


def colour_bar(axes: Axes, image: Any, shrink: float, aspect: float) -> Any:
    """A thin colour bar beside an image."""
    bar = axes.figure.colorbar(image, ax=axes, shrink=shrink, aspect=aspect, pad=0.03)
    bar.outline.set_linewidth(0.5)
    bar.ax.tick_params(labelsize=LABEL, width=0.5, length=2)
    return bar
