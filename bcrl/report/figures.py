"""Learning curves: Figures 1, 2 and 5 of the paper."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bcrl.common.divergence import diverging
from bcrl.report import style
from bcrl.report.notes import remarks, tags_shown
from bcrl.report.statistics import mean, standard_error
from bcrl.report.variants import Runs, Variant

FOOTER_WIDTH = 20  # characters of small print to an inch

ENV_TITLES = {
    "car_on_hill": "Car on the hill",
    "maze": "Maze",
    "linear_system": "Linear system",
}


def env_title(env: str) -> str:
    """An environment's name as a title: `Mountain car`, whoever it comes from."""
    return ENV_TITLES.get(env, env.replace("_", " ").capitalize())


def small_print(
    runs: Runs,
    methods: Mapping[str, Variant],
    what: str,
    width: float,
    compares: bool = True,
) -> list[str]:
    """The footer: environment, scale, number of seeds, what is drawn, notes.

    `width` of the figure in inches; `compares`: notes on differences between methods
    belong to it.
    """
    env = next(v.env for v in methods.values())
    counts = {name: len(v.seeds) for name, v in methods.items()}
    if len(set(counts.values())) == 1:
        n = next(iter(counts.values()))
        seeds = f"{n} seed{'s' * (n != 1)}{' per method' * (len(counts) > 1)}"
    else:
        seeds = "seeds " + ", ".join(f"{name} {n}" for name, n in counts.items())
    tags = tags_shown(methods)
    tagged = f" · {tags}" if tags else ""
    lines = [f"{env_title(env)} · scale {runs.scale} · {seeds}{tagged} · {what}"]
    lines += remarks(runs.notes, methods, compares)
    limit = int(width * FOOTER_WIDTH)
    return [part for line in lines for part in textwrap.wrap(line, limit)]


def optimum_of(methods: Mapping[str, Variant]) -> float | None:
    """The target's optimum if the methods agree on one."""
    optima = {v.optimum for v in methods.values()} - {None}
    return optima.pop() if len(optima) == 1 else None


def _mean_bands(axes: Axes, methods: Mapping[str, Variant], metric: str) -> None:
    """Mean ± 2 standard errors of every method."""
    far, within = [], []
    for name, variant in methods.items():
        values = variant.metrics[metric]
        centre, half = mean(values), 2 * standard_error(values)
        style.band(axes, variant.index, centre, centre - half, centre + half, name)
        if metric in diverging(variant.metrics):
            far.append(name)
        else:
            within += [centre - half, centre + half]
    style.cut(axes, far, within)


def _panels(
    methods: Mapping[str, Variant], labels: Sequence[str], size: tuple[float, float]
) -> tuple[Figure, list[Axes]]:
    """Panels side by side over the iterations, tasks shaded."""
    figure = Figure(figsize=size)
    panels = list(figure.subplots(1, len(labels), squeeze=False)[0])
    spans = style.stage_spans(methods.values())
    for axes, label in zip(panels, labels, strict=True):
        style.shade_tasks(axes, spans)
        axes.set_xlabel("iteration")
        axes.set_ylabel(label)
    return figure, panels


def figure_1(runs: Runs, tag: str | None = None) -> Figure:
    """Car on the hill: error and return, every seed and their mean (paper, Fig. 1)."""
    methods = runs.methods("car_on_hill", tag)
    labels = ("error, mean |Q − Q*|", "discounted return")
    figure, panels = _panels(methods, labels, (style.WIDTH, 3.3))
    for axes, metric in zip(panels, ("q_error", "return"), strict=True):
        for name, variant in methods.items():
            axes.plot(
                variant.index,
                variant.metrics[metric].T,
                color=style.colour(name),
                linewidth=0.5,
                linestyle=(0, (3, 2)),
                alpha=0.45,
            )
        far, within = [], []
        for name, variant in methods.items():
            centre = mean(variant.metrics[metric])
            axes.plot(variant.index, centre, color=style.colour(name), linewidth=2.0)
            if metric in diverging(variant.metrics):
                far.append(name)
            else:
                within.append(variant.metrics[metric])
        style.cut(axes, far, within)
    style.legend(figure, methods)
    what = "bold: mean over seeds, dashed: single seeds"
    style.footer(figure, small_print(runs, methods, what, style.WIDTH))
    return figure


def figure_2(runs: Runs, tag: str | None = None) -> Figure:
    """Maze: the paper's error at s0, the return (paper, Fig. 2) and the exact error.

    The paper's error compares Q(s0, ·) with the *target's* V*(s0) in every stage;
    the exact one averages |Q − Q*| over the states and actions of the current task.
    """
    methods = runs.methods("maze", tag)
    target = max(int(variant.task.max()) for variant in methods.values())
    labels = (
        f"error at the start, V* of T{target}\n"
        + r"mean$_a$ |Q(s$_0$, a) − V*(s$_0$)|",
        "discounted return",
        "error in the trained task\nmean |Q − Q*|",
    )
    width = 1.4 * style.WIDTH
    figure, panels = _panels(methods, labels, (width, 3.2))
    for axes, metric in zip(
        panels, ("q_error_start", "return", "q_error"), strict=True
    ):
        _mean_bands(axes, methods, metric)
    optimum = optimum_of(methods)
    if optimum is not None:
        panels[1].axhline(optimum, **style.OPTIMUM)
    for axes in (panels[0], panels[2]):
        axes.set_ylim(bottom=0)
    style.legend(figure, methods, optimum=optimum is not None)
    what = "mean ± 2 standard errors over seeds"
    style.footer(figure, small_print(runs, methods, what, width))
    return figure


def figure_5(runs: Runs, tag: str | None = None) -> Figure:
    """Maze: BC-FQI's residual at s0, averaged over actions (paper, Fig. 5)."""
    methods = {"BC-FQI": runs.methods("maze", tag)["BC-FQI"]}
    width = 0.75 * style.WIDTH
    label = "residual at the start\n" + r"mean$_a$ ϱ$_t$(s$_0$, a)"
    figure, (axes,) = _panels(methods, [label], (width, 3.0))
    axes.axhline(0.0, color="0.6", linewidth=0.6)
    _mean_bands(axes, methods, "residual_start")
    style.legend(figure, methods)
    what = "mean ± 2 standard errors over seeds"
    style.footer(figure, small_print(runs, methods, what, width, False))
    return figure
