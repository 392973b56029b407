"""A figure's size in print, its legend, its caption and its files."""

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.textpath import TextPath

from bcrl import __version__
from bcrl.common.files import write_atomically, write_text
from bcrl.errors import BcrlError
from bcrl.report.figures.style import OPTIMUM, Line, lines_of
from bcrl.report.variants import Methods, Runs, env_title, remarks, tags_shown

#: Widths by name, inches: a column and the whole text of a page with two columns.
WIDTHS = {"column": 3.25, "text": 6.75}
TEXT = WIDTHS["text"]
FORMATS = ("png", "pdf", "svg")
_LIMITS = (2.0, 30.0)  # inches
_DPI = 300
_PANEL = 2.1  # inches, below which no further panel stands beside
_ASPECT, _HEIGHTS = 0.66, (1.9, 2.5)  # a panel's height: share of its width, limits
_LEGEND = 8.0  # points, as in bcrl.mplstyle
_HANDLE = 4.4 * _LEGEND / 72  # inches of an entry without its text, gap included
_SMALL_PRINT = 7.0  # points
_LINE = 1.25  # height of a line of text in its own size


class Print(NamedTuple):
    """How figures are printed: width in inches, kinds of files, whether the caption is
    a text file instead of small print."""

    width: float = TEXT
    kinds: Sequence[str] = ("png", "pdf")
    caption_file: bool = False


def inches(width: str) -> float:
    """A figure's width from `column`, `text` or a number; BcrlError for another."""
    try:
        value = WIDTHS.get(width) or float(width)
    except ValueError:
        value = math.nan
    if not _LIMITS[0] <= value <= _LIMITS[1]:
        named = ", ".join(f"{name} ({size} in)" for name, size in WIDTHS.items())
        low, high = _LIMITS
        raise BcrlError(
            f"--width {width}: must be {named} or {low:g} to {high:g} inches"
        )
    return value


def formats(words: Sequence[str]) -> list[str]:
    """The kinds of files in `png`, `pdf,svg`; BcrlError for none or an unknown one."""
    given = " ".join(words)
    found = list(dict.fromkeys(given.lower().replace(",", " ").split()))
    if not found or not set(found) <= set(FORMATS):
        allowed = ", ".join(FORMATS)
        raise BcrlError(f"--format {given}: must be one or several of {allowed}")
    return found


def panels(n: int, width: float) -> tuple[Figure, list[Axes]]:
    """A figure with n panels, as many beside each other as `width` inches allow."""
    columns = max(1, min(n, 3, int(width / _PANEL)))
    rows = math.ceil(n / columns)
    low, high = _HEIGHTS
    height = rows * min(max(_ASPECT * width / columns, low), high)
    figure = Figure(figsize=(width, height))
    grid = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in grid[n:]:
        axes.set_axis_off()
    return figure, grid[:n]


def blocks(
    width: float, shares: Sequence[float], height: float
) -> tuple[Figure, dict[str, Any]]:
    """A figure and the grid of its parts, `height` inches each: beside each other with
    these shares, or one below the other where `width` is too small for three panels."""
    n = len(shares)
    if width >= 3 * _PANEL:
        grid = {"nrows": 1, "ncols": n, "width_ratios": shares}
        return Figure(figsize=(width, height)), grid
    return Figure(figsize=(width, n * height)), {"nrows": n, "ncols": 1}


def legend(
    figure: Figure, entries: Iterable[tuple[str, Line]], title: str | None = None
) -> None:
    """One legend for the whole figure, above it, in as few rows as it fits into."""
    named = list(entries)
    widths = [_text_width(name) + _HANDLE for name, _ in named]
    for rows in range(1, len(named) + 1):
        columns = [widths[at : at + rows] for at in range(0, len(named), rows)]
        if sum(map(max, columns)) <= figure.get_figwidth():
            break
    look = {"loc": "outside upper center", "ncols": len(columns), "title": title}
    figure.legend(
        handles=[Line2D([], [], label=n, **line) for n, line in named], **look
    )
    _grow(figure, (rows + bool(title)) * _LEGEND * 1.4)


@cache
def _text_width(text: str) -> float:
    """Inches that a text takes in the legend."""
    path = TextPath((0, 0), text, size=_LEGEND, prop=FontProperties())
    return path.get_extents().width / 72


def _grow(figure: Figure, points: float) -> None:
    """Make a figure higher, so that its panels keep their height."""
    figure.set_figheight(figure.get_figheight() + points / 72)


def finish(
    figure: Figure,
    runs: Runs,
    methods: Methods,
    what: str,
    optimum: bool = False,
    compares: bool = True,
    lines: Mapping[str, Line] | None = None,
) -> Figure:
    """The figure with a legend of the methods, which may have other looks, `lines`, and
    a `caption`."""
    entries = [*(lines or lines_of(methods)).items()]
    legend(figure, entries + [("optimum of the target", OPTIMUM)] * optimum)
    return caption(figure, runs, methods, what, compares)


def caption(
    figure: Figure, runs: Runs, methods: Methods, what: str, compares: bool = True
) -> Figure:
    """The figure with small print, which is its label, too: environment, seeds, `what`
    is drawn, `remarks`."""
    envs = dict.fromkeys(env_title(v.env) for v in methods.values())
    counts = [len(v.seeds) for v in methods.values()]
    n = "–".join(map(str, sorted({min(counts), max(counts)})))
    seeds = f"{n} seed{'s' * (n != '1')}{' each' * (len(counts) > 1)}"
    about = [", ".join(envs), f"scale {runs.scale}", seeds, tags_shown(methods), what]
    lines = [" · ".join(filter(None, about)), *remarks(runs, methods, compares)]
    figure.set_label("\n".join(lines))
    _small_print(figure, lines)
    return figure


def _small_print(figure: Figure, lines: Sequence[str]) -> None:
    """Write these lines below a figure, instead of those that were there."""
    before = figure.get_supxlabel()
    limit = int(figure.get_figwidth() * 72 / (0.55 * _SMALL_PRINT))
    wrap = partial(textwrap.wrap, width=limit, break_on_hyphens=False)
    kept = (line.replace(" %", "\u00a0%") for line in lines)  # on one line
    wrapped = [part for line in kept for part in wrap(line)]
    look = {"x": 0.01, "ha": "left", "fontsize": _SMALL_PRINT, "color": "0.35"}
    figure.supxlabel("\n".join(wrapped), **look)
    more = len(wrapped) - len(before.splitlines())
    _grow(figure, more * _LINE * _SMALL_PRINT)


def save_figure(
    figure: Figure, folder: Path, name: str, title: str, how: Print | None = None
) -> list[Path]:
    """Write `name`.png and so on, atomically, without a date inside, all of one size.
    Where the caption is a text file, remarks stay in the figure, too."""
    how = how or Print()
    software, text, files = f"bcrl {__version__}", figure.get_label(), []
    about = {
        "png": {"Title": title, "Software": software, "Description": text},
        "pdf": {"Title": title, "Creator": software, "CreationDate": None},
        "svg": {"Title": title, "Creator": software, "Date": None},
    }
    about["pdf"]["Subject"] = about["svg"]["Description"] = text
    if how.caption_file:
        _small_print(figure, text.splitlines()[1:])
    for kind in how.kinds:
        write = partial(figure.savefig, format=kind, dpi=_DPI, metadata=about[kind])
        files.append(write_atomically(folder / f"{name}.{kind}", write))
    if how.caption_file:
        files.append(write_text(folder / f"{name}.txt", f"{text}\n"))
    return files
