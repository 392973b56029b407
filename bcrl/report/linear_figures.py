"""Figure 4 of the paper: the linear system's learning curves, priors and target."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle
from numpy.typing import NDArray

from bcrl.report import style
from bcrl.report.curves import (
    LEARNERS,
    figure_methods,
    pretraining,
    pretraining_rows,
    switches,
    target_rows,
)
from bcrl.report.figures import small_print
from bcrl.report.findings import unreadable
from bcrl.report.statistics import mean, standard_error
from bcrl.report.variants import Runs, Variant

WORST = -150.0  # target return of a policy that never succeeds: −1 in each of 150 steps
SHOWN_SEED = {"lspi": 0, "dqn": 10}  # whose Q the paper's Figure 4b shows
COLOURS = {"lspi": style.colour("LSPI"), "dqn": style.colour("C-DQN")}
APART = 0.18  # share of the axis below which neighbouring labels take two rows
EVERY = 4  # grid points to an arrow
NO_RUNS = {"ha": "center", "va": "center", "color": "0.5"}


def _curve(
    axes: Axes, variant: Variant, rows: NDArray[np.intp], metric: str, method: str
) -> None:
    """Mean ± 2 standard errors over environment steps."""
    values = variant.metrics[metric][:, rows]
    centre, half = mean(values), 2 * standard_error(values)
    x = variant.index[rows]
    style.band(axes, x, centre, centre - half, centre + half, method)


def _step_axis(axes: Axes) -> None:
    axes.set_xlabel("environment steps, pretraining included")
    axes.xaxis.set_major_formatter(lambda x, _: f"{x:,.0f}".replace(",", "\u2009"))
    axes.locator_params(axis="x", nbins=6)


def _draw_target(axes: Axes, methods: Mapping[str, Variant]) -> None:
    small = {"textcoords": "offset points", "fontsize": 6.5, "color": "0.35"}
    axes.axhline(WORST, color="0.6", linewidth=0.6)
    axes.annotate(
        "never succeeding",
        (1.0, WORST),
        xycoords=("axes fraction", "data"),
        xytext=(0, -2),
        ha="right",
        va="top",
        **small,
    )
    for name, variant in methods.items():
        _curve(axes, variant, target_rows(variant), "return", name)
    end = max(int(variant.index[-1]) for variant in methods.values())
    axes.set_xlim(0, 1.03 * end)
    bottom, top = axes.get_ylim()
    axes.set_ylim(bottom=min(bottom, WORST - 0.07 * (top - WORST)))  # room for a word
    previous = -np.inf
    for (learner, step), label in sorted(switches(methods).items(), key=_step):
        raised = step - previous < APART * end
        previous = step
        axes.axvline(step, color=COLOURS.get(learner, "0.5"), linestyle=":")
        axes.annotate(
            label,
            (step, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 10 if raised else 2),
            ha="left",
            va="bottom",
            **small,
        )
    axes.set_ylabel("return in the target task (undiscounted)")


def _step(switch: tuple[tuple[str, int], str]) -> int:
    (_, step), _ = switch
    return step


def _draw_pretraining(axes: Axes, methods: Mapping[str, Variant]) -> None:
    found = pretraining(methods)
    handles = []
    for learner, variant in found.items():
        name = LEARNERS[learner]
        source = "LSPI" if learner == "lspi" else "C-DQN"
        rows = pretraining_rows(variant)
        _curve(axes, variant, rows, "discounted_return", source)
        n = len(variant.seeds)
        label = f"{name}, {n} seed{'s' * (n != 1)}"
        handles.append(Line2D([], [], color=COLOURS[learner], linewidth=2, label=label))
    if handles:
        axes.legend(handles=handles, loc="lower right", fontsize=7)
    else:
        axes.text(0.5, 0.5, "no pretraining", transform=axes.transAxes, **NO_RUNS)
    axes.set_ylabel("discounted return in the LQ task")
    axes.set_title("pretraining", pad=3)


def figure_4a(runs: Runs, tag: str | None = None) -> Figure:
    """Linear system: return against environment steps, and the pretraining's own.

    Mean ± 2 standard errors over seeds, under the exploring policy (paper, Fig. 4a).
    """
    methods = figure_methods(runs, tag)
    width = 1.3 * style.WIDTH
    figure = Figure(figsize=(width, 3.5))
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    _draw_target(left, methods)
    _draw_pretraining(right, methods)
    for axes in (left, right):
        _step_axis(axes)
    style.legend(figure, methods)
    what = "mean ± 2 standard errors over seeds, exploring policy; dotted: new task"
    style.footer(figure, small_print(runs, methods, what, width))
    return figure


def prior(variant: Variant, seed: int) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """The first stage's Q of a seed on the x–y plane at zero velocity.

    Axes x (X,), y (Y,), value max_a Q (X, Y) and the greedy action's force (X, Y, 2).
    Raises BcrlError if the states are no whole x-major grid or the shapes disagree.
    """
    states, q, actions = variant.arrays(seed, "states", "q_stages", "actions")
    if q.ndim != 3 or q.shape[1:] != (len(states), len(actions)) or not len(q):
        raise unreadable(variant.npz(seed), f"has a q_stages of shape {q.shape}")
    plane = states[:, [0, 2]]  # state order x, ẋ, y, ẏ
    x, y = np.unique(plane[:, 0]), np.unique(plane[:, 1])
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    if grid.shape != plane.shape or not np.allclose(grid, plane):
        raise unreadable(variant.npz(seed), "has states that are no grid")
    force = actions[q[0].argmax(axis=1)]
    return x, y, q[0].max(axis=1).reshape(len(x), -1), force.reshape(len(x), -1, 2)


def _draw_prior(axes: Axes, learner: str, variant: Variant | None) -> None:
    axes.set(xlabel="position x", ylabel="position y", aspect="equal")
    name = LEARNERS[learner].removesuffix(" on LQ")
    title = rf"{name}: max$_a$ Q in the LQ task"
    if variant is None:
        axes.set_title(title, pad=4)
        axes.set(xlim=(-5, 5), ylim=(-5, 5))
        axes.text(0, 0, "no runs", **NO_RUNS)
        return
    wished = SHOWN_SEED[learner]
    seed = wished if wished in variant.seeds else min(variant.seeds)
    x, y, value, force = prior(variant, seed)
    image = axes.pcolormesh(x, y, value.T, cmap="viridis", rasterized=True)
    at = slice(None, None, EVERY)
    fx, fy = force[at, at, 0].T, force[at, at, 1].T
    axes.quiver(
        *(x[at], y[at], fx, fy),
        color="white",
        edgecolor="black",
        linewidth=0.4,
        pivot="middle",
        scale=16,
        width=0.009,
    )
    axes.set_title(f"{title}, seed {seed}", pad=4)
    bar = axes.figure.colorbar(image, ax=axes, shrink=0.75, aspect=16, pad=0.03)
    bar.outline.set_linewidth(0.5)
    bar.ax.tick_params(labelsize=6.5, width=0.5, length=2)


def _draw_environment(axes: Axes, variant: Variant) -> None:
    """The target: strip, walls, goal, start region and drift."""
    seed = min(variant.seeds)
    pathway, goal, start, drift = variant.arrays(
        seed, "pathway", "goal", "start", "drift"
    )
    shapes = [np.shape(array) for array in (pathway, goal, start, drift)]
    if shapes != [(4,), (3,), (4,), (2,)]:
        raise unreadable(variant.npz(seed), f"describes its target in shapes {shapes}")
    x0, y0, x1, y1 = pathway
    length, margin = x1 - x0, 0.08 * (x1 - x0)
    axes.set(xlabel="position x", ylabel="position y", aspect="equal")
    axes.set(xlim=(x0 - margin, x1 + margin), ylim=(y0 - length / 3, y1 + length / 3))
    axes.set_title("target task", pad=4)
    axes.set_facecolor("0.88")
    axes.add_patch(
        Rectangle((x0, y0), length, y1 - y0, facecolor="white", edgecolor="none")
    )
    axes.hlines([y0, y1], x0, x1, color="0.5", linewidth=0.8, linestyle=(0, (3, 2)))
    axes.vlines([x0, x1], *axes.get_ylim(), color="black", linewidth=2.2)
    axes.add_patch(
        Circle(goal[:2], goal[2], facecolor=style.colour("B"), edgecolor="black")
    )
    corner, size = start[:2], start[2:] - start[:2]
    region = {"facecolor": style.colour("SC"), "edgecolor": style.colour("DQN")}
    axes.add_patch(Rectangle(corner, *size, linewidth=2, zorder=3, **region))
    middle = ((x0 + x1) / 2, (y0 + y1) / 2)
    small = {"fontsize": 6.5, "ha": "center", "xycoords": "data"}
    small |= {"textcoords": "offset points"}
    above, below = small | {"va": "bottom"}, small | {"va": "top"}
    speed = float(np.hypot(*drift))
    if speed > 0:
        axes.quiver(*middle, *(drift / speed), scale=6, width=0.012)
        axes.annotate(f"drift {speed:g}", (middle[0], y1), (0, 2), **above)
    axes.annotate("goal", (goal[0], y1), (0, 2), **above)
    start_x = (start[0] + start[2]) / 2
    axes.annotate("start", (start_x, y1), (0, 2), **above)
    off = "off the pathway: back to the start"
    axes.annotate(off, (middle[0], y0), (0, -6), **below)
    top = axes.get_ylim()[1]
    for x, where, shift in ((x0, "left", 4), (x1, "right", -4)):
        axes.annotate(
            "wall, reflecting", (x, top), (shift, -3), **below | {"ha": where}
        )


def figure_4b(runs: Runs, tag: str | None = None) -> Figure:
    """Linear system: both priors' values and greedy actions, and the target task.

    LSPI's and DQN's LQ Q-functions on the plane of positions at zero velocity, each
    with its own colour scale (paper, Fig. 4b).
    """
    methods = figure_methods(runs, tag)
    found = pretraining(methods)
    width = 1.45 * style.WIDTH
    figure = Figure(figsize=(width, 3.8))  # so high that the widths decide
    panels = figure.subplots(1, 3, width_ratios=(1.15, 1.15, 1))
    for axes, learner in zip(panels, LEARNERS, strict=False):
        _draw_prior(axes, learner, found.get(learner))
    variant = next(iter(methods.values()))
    _draw_environment(panels[2], variant)
    shown = {v.method: v for v in found.values()} or {variant.method: variant}
    what = "one seed a panel, own colour scales; arrows: greedy action at zero velocity"
    style.footer(figure, small_print(runs, shown, what, width, compares=False))
    return figure
