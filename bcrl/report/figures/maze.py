"""Figure 3 of the paper: the mazes, the learned values, the greedy trajectories."""

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Rectangle

from bcrl.report.figures import layout, style
from bcrl.report.variants import METHODS, Methods, Runs, Variant

_MARGIN = 0.025  # half a lattice cell
_SPREAD = 0.012  # how far apart the seeds' trajectories are drawn, in maze lengths


def _draw_walls(axes: Axes, walls: np.ndarray, filled: bool = True) -> None:
    """Rectangles (walls, 4) as x0, y0, x1, y1: filled, or outlined over an image."""
    look = {"facecolor": "0.55", "edgecolor": "0.35", "linewidth": 0.5}
    if not filled:
        look = {"fill": False, "edgecolor": "white", "linewidth": 0.9}
    for x0, y0, x1, y1 in walls:
        axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, zorder=2, **look))


def _draw_ends(axes: Axes, goal: np.ndarray, start: np.ndarray) -> None:
    """A circle where episodes start, a star at the goal."""
    marks = {"linestyle": "none", "markeredgewidth": 0.7, "zorder": 5}
    marks |= {"markerfacecolor": "white", "markeredgecolor": "black", "clip_on": False}
    axes.plot(*start, marker="o", markersize=4.5, **marks)
    axes.plot(*goal, marker="*", markersize=9, **marks)


def _frame(axes: Axes, title: str) -> None:
    """The unit square, without ticks."""
    limits = -_MARGIN, 1 + _MARGIN
    axes.set(xlim=limits, ylim=limits, xticks=[], yticks=[], aspect="equal")
    axes.set_title(title, pad=3, fontsize=8)
    axes.spines[:].set_visible(True)


def seed_mean_value(variant: Variant) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Axes x (X,), y (Y,) of the x-major lattice, max_a of the seed-mean Q (X, Y)."""
    loaded = [variant.arrays(seed, "states", "q") for seed in variant.seeds]
    x, y = (np.unique(column) for column in loaded[0][0].T)
    value = np.mean([q for _, q in loaded], axis=0).max(axis=1)
    return x, y, value.reshape(len(x), len(y))


def _draw_paths(axes: Axes, name: str, variant: Variant, goal: np.ndarray) -> None:
    """Every seed's greedy episode, side by side: lattice paths coincide."""
    n = len(variant.seeds)
    shifts = np.linspace(-_SPREAD, _SPREAD, n) if n > 1 else [0.0]
    look = {"color": style.colour(name), "linewidth": 0.7, "alpha": 0.6, "zorder": 3}
    for seed, shift in zip(variant.seeds, shifts, strict=True):
        (path,) = variant.arrays(seed, "trajectory")  # (L, 2)
        axes.plot(path[:, 0] + shift, path[:, 1] - shift, **look)
    _draw_ends(axes, goal, path[0])
    _frame(axes, f"{name}: {int(variant.last('solved').sum())}/{n}")


def _grid(panel: SubFigure, methods: Methods) -> Iterator[tuple[Axes, str, Variant]]:
    """2 × 2 axes, each method at its own place; absent ones are marked."""
    for axes, name in zip(panel.subplots(2, 2).flat, METHODS, strict=True):
        if name in methods:
            yield axes, name, methods[name]
        else:
            _frame(axes, name)
            axes.text(0.5, 0.5, "no runs", **style.EMPTY)


def figure_3(runs: Runs, tag: str | None = None, width: float = layout.TEXT) -> Figure:
    """Mazes, max_a of the seed-mean Q on the target, greedy episodes (paper, Fig. 3).
    Values are drawn inside walls too, where no data lay; colour scales differ."""
    methods = runs.methods("maze", tag)
    reference = max(methods.values(), key=lambda v: len(np.unique(v.task)))
    names = ("walls", "goal", "trajectory")
    walls, goal, path = reference.arrays(reference.seeds[0], *names)
    figure, grid = layout.blocks(width, (1.0, 1.28, 1.0), 2.6)
    panels = figure.subfigures(**grid)
    target = f"T{len(walls)}"
    titles = (
        "(a) curriculum",
        rf"(b) max$_a$ Q(s, a) on {target}",
        f"(c) greedy episodes on {target}",
    )
    for panel, title in zip(panels, titles, strict=True):
        panel.suptitle(title, fontsize=8)
    shown = np.linspace(0, len(walls) - 1, 4).round().astype(int)
    for axes, task in zip(panels[0].subplots(2, 2).flat, shown, strict=True):
        _draw_walls(axes, walls[task])
        _draw_ends(axes, goal, path[0])
        _frame(axes, f"T{task + 1}")
    for axes, name, variant in _grid(panels[1], methods):
        x, y, value = seed_mean_value(variant)
        image = axes.pcolormesh(x, y, value.T, cmap="viridis", rasterized=True)
        _draw_walls(axes, walls[-1], filled=False)
        _frame(axes, name)
        style.colour_bar(axes, image, shrink=0.9, aspect=14).ax.locator_params(nbins=5)
    for axes, name, variant in _grid(panels[2], methods):
        _draw_walls(axes, walls[-1])
        _draw_paths(axes, name, variant, goal)
    what = "circle: start, star: goal; (b) mean Q over seeds; (c) after the last "
    what += "iteration, seeds side by side, with the share that arrives"
    return layout.caption(figure, runs, methods, what)
