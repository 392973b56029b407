"""Figure 3 of the paper: the mazes, the learned values, the greedy trajectories."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from bcrl.report import style
from bcrl.report.figures import small_print
from bcrl.report.findings import unreadable
from bcrl.report.variants import METHODS, Runs, Variant

SIZE = (11.4, 4.2)  # inches
MARGIN = 0.025  # half a lattice cell
SPREAD = 0.012  # how far apart the seeds' trajectories are drawn, in maze lengths
SHOWN_MAZES = 4


def draw_walls(axes: Axes, walls: NDArray[np.float64], filled: bool = True) -> None:
    """Rectangles (walls, 4) as x0, y0, x1, y1: filled, or outlined over an image."""
    for x0, y0, x1, y1 in walls:
        style_of = {"facecolor": "0.55", "edgecolor": "0.35", "linewidth": 0.5}
        if not filled:
            style_of = {"fill": False, "edgecolor": "white", "linewidth": 0.9}
        axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, zorder=2, **style_of))


def draw_ends(
    axes: Axes, goal: NDArray[np.float64], start: NDArray[np.float64]
) -> None:
    """A circle where episodes start, a star at the goal."""
    marks = {"linestyle": "none", "markeredgewidth": 0.7, "zorder": 5}
    marks |= {"markerfacecolor": "white", "markeredgecolor": "black", "clip_on": False}
    axes.plot(*start, marker="o", markersize=4.5, **marks)
    axes.plot(*goal, marker="*", markersize=9, **marks)


def frame(axes: Axes, title: str) -> None:
    """The unit square, without ticks."""
    axes.set(xlim=(-MARGIN, 1 + MARGIN), ylim=(-MARGIN, 1 + MARGIN), aspect="equal")
    axes.set(xticks=[], yticks=[])
    axes.set_title(title, pad=3, fontsize=8)
    axes.spines[:].set_visible(True)


def seed_mean_value(variant: Variant) -> tuple[NDArray, NDArray, NDArray]:
    """Lattice axes x (X,), y (Y,) and max_a of the seed-mean Q there, (X, Y).

    Raises BcrlError if a seed's states are not one whole x-major lattice.
    """
    total: NDArray[np.float64] | None = None
    for seed in variant.seeds:
        states, q = variant.arrays(seed, "states", "q")
        x, y = np.unique(states[:, 0]), np.unique(states[:, 1])
        lattice = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
        if lattice.shape != states.shape or not np.allclose(lattice, states):
            raise unreadable(variant.npz(seed), "has states that are no lattice")
        if total is not None and total.shape != q.shape:
            raise unreadable(variant.npz(seed), f"has a q of shape {q.shape}")
        total = q if total is None else total + q
    value = (total / len(variant.seeds)).max(axis=1)
    return x, y, value.reshape(len(x), len(y))


def trajectories(variant: Variant) -> list[NDArray[np.float64]]:
    """Every seed's greedy episode, (L, 2) each; lengths differ."""
    found = []
    for seed in variant.seeds:
        (path,) = variant.arrays(seed, "trajectory")
        if path.ndim != 2 or path.shape[1] != 2 or not len(path):
            what = f"has a trajectory of shape {path.shape}, expected (L, 2)"
            raise unreadable(variant.npz(seed), what)
        found.append(path)
    return found


def _mazes(panel: SubFigure, walls: NDArray, goal: NDArray, start: NDArray) -> None:
    shown = np.linspace(0, len(walls) - 1, SHOWN_MAZES).round().astype(int)
    for axes, task in zip(panel.subplots(2, 2).flat, shown, strict=True):
        draw_walls(axes, walls[task])
        draw_ends(axes, goal, start)
        frame(axes, f"T{task + 1}")


def _values(
    panel: SubFigure, methods: Mapping[str, Variant], walls: NDArray, goal: NDArray
) -> None:
    for axes, (name, variant) in _grid(panel, methods):
        x, y, value = seed_mean_value(variant)
        image = axes.pcolormesh(x, y, value.T, cmap="viridis", rasterized=True)
        draw_walls(axes, walls, filled=False)
        frame(axes, name)
        bar = panel.colorbar(image, ax=axes, shrink=0.9, aspect=14, pad=0.03)
        bar.outline.set_linewidth(0.5)
        bar.ax.tick_params(labelsize=6.5, width=0.5, length=2)
        bar.ax.locator_params(nbins=5)


def _paths(
    panel: SubFigure, methods: Mapping[str, Variant], walls: NDArray, goal: NDArray
) -> None:
    for axes, (name, variant) in _grid(panel, methods):
        draw_walls(axes, walls)
        paths = trajectories(variant)
        # Lattice paths coincide: drawn side by side, one can see how many there are.
        shifts = np.linspace(-SPREAD, SPREAD, len(paths)) if len(paths) > 1 else [0.0]
        for path, shift in zip(paths, shifts, strict=True):
            axes.plot(
                path[:, 0] + shift,
                path[:, 1] - shift,
                color=style.colour(name),
                linewidth=0.7,
                alpha=0.6,
                zorder=3,
            )
        draw_ends(axes, goal, paths[0][0])
        solved = int(variant.metrics["solved"][:, -1].sum())
        frame(axes, f"{name}: {solved} of {len(paths)} arrive")


def _grid(
    panel: SubFigure, methods: Mapping[str, Variant]
) -> Iterator[tuple[Axes, tuple[str, Variant]]]:
    """2 × 2 axes, each method at its own place; absent ones are said to be."""
    for axes, name in zip(panel.subplots(2, 2).flat, METHODS, strict=True):
        if name in methods:
            yield axes, (name, methods[name])
        else:
            frame(axes, name)
            axes.text(0.5, 0.5, "no runs", ha="center", va="center", color="0.5")


def figure_3(runs: Runs, tag: str | None = None) -> Figure:
    """Mazes, max_a of the seed-mean Q on the target, greedy episodes (paper, Fig. 3).

    The values are drawn for all lattice points, those inside walls too, where no data
    ever lay; every panel has its own colour scale.
    """
    methods = runs.methods("maze", tag)
    reference = max(methods.values(), key=lambda v: len(np.unique(v.task)))
    walls, goal, path = reference.arrays(
        reference.seeds[0], "walls", "goal", "trajectory"
    )
    figure = Figure(figsize=SIZE)
    figure.get_layout_engine().set(w_pad=0.07)
    target = f"T{len(walls)}"
    titles = (
        "(a) tasks of the curriculum",
        rf"(b) max$_a$ of the seed-mean Q(s, a) on {target}",
        f"(c) greedy episodes in {target}, last iteration",
    )
    panels = figure.subfigures(1, 3, width_ratios=(1.0, 1.28, 1.0), wspace=0.03)
    for panel, title in zip(panels, titles, strict=True):
        panel.suptitle(title, fontsize=9)
    _mazes(panels[0], walls, goal, path[0])
    _values(panels[1], methods, walls[-1], goal)
    _paths(panels[2], methods, walls[-1], goal)
    what = "circle: start, star: goal; in (c) seeds are drawn side by side"
    style.footer(figure, small_print(runs, methods, what, SIZE[0]))
    return figure
