"""Figure 4 of the paper: the linear system's learning curves, priors and target."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle

from bcrl.report.figures import layout, style
from bcrl.report.figures.curves import BAND, draw_metric
from bcrl.report.variants import LINEAR, Methods, Runs, Variant

#: A learner's name in the records → in the figures; whose colour it has.
_LEARNERS = {"lspi": "LSPI", "dqn": "DQN on LQ"}
_SOURCES = {"lspi": "LSPI", "dqn": "C-DQN"}
_SHOWN_SEED = {"lspi": 0, "dqn": 10}  # whose Q the paper's Figure 4b shows
_WORST = -150.0  # target return of a policy that never succeeds: −1 in 150 steps
_APART = 0.4  # share of the axis below which neighbouring labels take two rows
_EVERY = 4  # grid points per arrow
_SMALL = style.SMALL | {"fontsize": style.LABEL}


def _pretraining_rows(variant: Variant) -> np.ndarray:
    """Rows of a first stage on another task than the target; may be none, (P,)."""
    return np.flatnonzero((variant.stage == 1) & (variant.task != variant.target))


def pretraining(methods: Methods) -> dict[str, Variant]:
    """A variant that shows each learner's pretraining: the one with most seeds. Methods
    that pretrain with the same learner share that stage, draw by draw."""
    found: dict[str, Variant] = {}
    for variant in sorted(methods.values(), key=lambda v: -len(v.seeds)):
        if len(_pretraining_rows(variant)):
            found.setdefault(variant.sidecars[0]["learners"][0], variant)
    return {learner: found[learner] for learner in _LEARNERS if learner in found}


def _draw_target(axes: Axes, methods: Methods) -> None:
    axes.axhline(_WORST, color="0.6", linewidth=0.6)
    place = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "top"}
    axes.annotate("never succeeding", (1.0, _WORST), (0, -2), **place, **_SMALL)
    draw_metric(axes, methods, "return", lambda variant: variant.target_rows)
    end = max(int(variant.index[-1]) for variant in methods.values())
    axes.set(xlim=(0, 1.03 * end), ylabel="return in the target task\n(undiscounted)")
    bottom, top = axes.get_ylim()
    axes.set_ylim(bottom=min(bottom, _WORST - 0.1 * (top - _WORST)))  # room for a word
    switches = {
        (int(v.index[rows[-1]]), v.sidecars[0]["learners"][0])
        for v in methods.values()
        if len(rows := _pretraining_rows(v))
    }
    previous = -np.inf
    place = {"xycoords": ("data", "axes fraction"), "ha": "left", "va": "bottom"}
    for step, learner in sorted(switches):
        colour = style.colour(_SOURCES[learner]) if learner in _SOURCES else "0.5"
        axes.axvline(step, color=colour, linestyle=":", linewidth=1.0)
        raised = 10 if step - previous < _APART * end else 2
        text = f"{_LEARNERS.get(learner, learner)} → target"
        axes.annotate(text, (step, 1.0), (0, raised), **place, **_SMALL)
        previous = step


def _draw_pretraining(axes: Axes, methods: Methods) -> None:
    handles = []
    for learner, variant in pretraining(methods).items():
        source, n = _SOURCES[learner], len(variant.seeds)
        draw_metric(axes, {source: variant}, "discounted_return", _pretraining_rows)
        label = f"{_LEARNERS[learner]}, {n} seed{'s' * (n != 1)}"
        (line,) = style.lines_of([source]).values()
        handles.append(Line2D([], [], label=label, **line))
    if handles:  # above the axes, where no curve is
        place = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0)}
        axes.legend(handles=handles, title="pretraining", **place)
    else:
        axes.text(0.5, 0.5, "no pretraining", transform=axes.transAxes, **style.EMPTY)
    axes.set_ylabel("discounted return\nin the LQ task")


def figure_4a(runs: Runs, tag: str | None = None, width: float = layout.TEXT) -> Figure:
    """Linear system: return against environment steps, and the pretraining's own.
    Mean and 95 % interval over seeds, under the exploring policy (paper, Fig. 4a)."""
    methods = runs.compared(LINEAR, tag, "DQN")
    figure, grid = layout.blocks(width, (2.0, 1.0), 2.6)
    left, right = figure.subplots(**grid)
    _draw_target(left, methods)
    _draw_pretraining(right, methods)
    for axes in (left, right):
        axes.set_xlabel("environment steps")
        style.number_axis(axes)
    what = f"{BAND}, exploring policy, steps of pretraining included, dotted: new task"
    return layout.finish(figure, runs, methods, what)


def prior(variant: Variant, seed: int) -> tuple[np.ndarray, ...]:
    """The first stage's Q of a seed on the x–y plane at zero velocity. Axes x (X,), y
    (Y,), value max_a Q (X, Y) and the greedy action's force (X, Y, 2)."""
    states, q, actions = variant.arrays(seed, "states", "q_stages", "actions")
    x, y = np.unique(states[:, 0]), np.unique(states[:, 2])  # x, ẋ, y, ẏ; x-major
    force = actions[q[0].argmax(axis=1)]
    return x, y, q[0].max(axis=1).reshape(len(x), -1), force.reshape(len(x), -1, 2)


def _draw_prior(axes: Axes, learner: str, variant: Variant | None) -> None:
    title = "max$_a$ Q in the LQ task\n" + learner.upper()
    if variant is None:
        axes.set_title(title, pad=4)
        axes.set(xlim=(-5, 5), ylim=(-5, 5))
        axes.text(0, 0, "no runs", **style.EMPTY)
        return
    wished = _SHOWN_SEED[learner]
    seed = wished if wished in variant.seeds else min(variant.seeds)
    x, y, value, force = prior(variant, seed)
    image = axes.pcolormesh(x, y, value.T, cmap="viridis", rasterized=True)
    at = slice(None, None, _EVERY)
    fx, fy = force[at, at].T
    look = {"color": "white", "edgecolor": "black", "linewidth": 0.4}
    axes.quiver(x[at], y[at], fx, fy, pivot="middle", scale=16, width=0.009, **look)
    axes.set_title(f"{title}, seed {seed}", pad=4)
    style.colour_bar(axes, image, shrink=0.75, aspect=16)


def _draw_environment(axes: Axes, variant: Variant) -> None:
    """The target: strip, walls, goal, start region and drift."""
    names = ("pathway", "goal", "start", "drift")
    (x0, y0, x1, y1), goal, start, drift = variant.arrays(min(variant.seeds), *names)
    length, margin = x1 - x0, 0.08 * (x1 - x0)
    axes.set(xlim=(x0 - margin, x1 + margin), ylim=(y0 - length / 3, y1 + length / 3))
    axes.set_title("target task", pad=4)
    axes.set_facecolor("0.88")
    axes.add_patch(Rectangle((x0, y0), length, y1 - y0, fc="white", ec="none"))
    axes.hlines([y0, y1], x0, x1, color="0.5", linewidth=0.8, linestyle=(0, (3, 2)))
    axes.vlines([x0, x1], *axes.get_ylim(), color="black", linewidth=2.2)
    axes.add_patch(Circle(goal[:2], goal[2], fc=style.colour("B"), ec="black"))
    look = {"fc": style.colour("SC"), "ec": style.colour("DQN"), "lw": 2, "zorder": 3}
    axes.add_patch(Rectangle(start[:2], *(start[2:] - start[:2]), **look))
    middle, speed, top = (x0 + x1) / 2, float(np.hypot(*drift)), axes.get_ylim()[1]
    names = [("goal", goal[0]), ("start", (start[0] + start[2]) / 2)]
    if speed > 0:
        axes.quiver(middle, (y0 + y1) / 2, *(drift / speed), scale=6, width=0.012)
        names.append((f"drift {speed:g}", middle))
    small = {"fontsize": style.LABEL, "textcoords": "offset points"}
    for name, x in names:
        axes.annotate(name, (x, y1), (0, 2), ha="center", va="bottom", **small)
    for x, shift, side in ((x0, (4, -3), "left"), (x1, (-4, -3), "right")):
        axes.annotate("wall", (x, top), shift, ha=side, va="top", **small)


def figure_4b(runs: Runs, tag: str | None = None, width: float = layout.TEXT) -> Figure:
    """Linear system: both priors' values and greedy actions, and the target task.
    Q in the LQ task on the plane of positions at zero velocity (paper, Fig. 4b)."""
    methods = runs.compared(LINEAR, tag, "DQN")
    found = pretraining(methods)
    figure, grid = layout.blocks(width, (1.15, 1.15, 1.0), 2.3)
    names = {"xlabel": "position x", "ylabel": "position y", "aspect": "equal"}
    panels = figure.subplots(**grid, subplot_kw=names)
    for axes, learner in zip(panels, _LEARNERS, strict=False):
        _draw_prior(axes, learner, found.get(learner))
    variant = next(iter(methods.values()))
    _draw_environment(panels[2], variant)
    shown = {v.method: v for v in found.values()} or {variant.method: variant}
    what = "one seed per panel, own colour scales; arrows: greedy action at zero "
    what += (
        "velocity; target: walls reflect, an agent off the pathway returns to its start"
    )
    return layout.caption(figure, runs, shown, what, compares=False)
