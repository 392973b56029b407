"""`bcrl-report`: figures, aggregate and claims from the runs of one scale."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from bcrl.common.files import make_directory, write_text
from bcrl.common.terminal import ready, say, show
from bcrl.errors import BcrlError
from bcrl.report import style
from bcrl.report.animation import animations, gif_of
from bcrl.report.arguments import Parser
from bcrl.report.curves import LINEAR, figure_methods
from bcrl.report.document import claims_report
from bcrl.report.figures import env_title, figure_1, figure_2, figure_5
from bcrl.report.learning import figure_curves
from bcrl.report.linear_figures import figure_4a, figure_4b
from bcrl.report.load import COMPARED, load_runs
from bcrl.report.maze_figure import figure_3
from bcrl.report.page import Picture, Pictures, page
from bcrl.report.sweeps import groups, sweep_report, sweep_table
from bcrl.report.tables import aggregate
from bcrl.report.variants import Runs

#: figure → environment, experiment that makes its runs, method it cannot do without
FIGURES: dict[str, tuple[str, str, str | None, Callable[..., Figure]]] = {
    "1": ("car_on_hill", "fig1", None, figure_1),
    "2": ("maze", "fig2", None, figure_2),
    "3": ("maze", "fig2", None, figure_3),
    "4a": (LINEAR, "fig4", None, figure_4a),
    "4b": (LINEAR, "fig4", None, figure_4b),
    "5": ("maze", "fig2", "BC-FQI", figure_5),
}
CURVES = "curves"  # learning curves of what the paper has no figure of


def parser() -> Parser:
    """The command line; its help is the reference."""
    result = Parser(
        prog="bcrl-report",
        description="Draw figures of finished runs, judge the paper's claims, and show "
        "all of it on one HTML page.",
    )
    result.add_argument(
        "--scale",
        default="quick",
        help="smoke, quick, paper or search; default: %(default)s",
    )
    result.add_argument(
        "--figures",
        nargs="+",
        default=["all"],
        choices=["all", *FIGURES, CURVES],
        metavar="N",
        help=f"which of {', '.join(FIGURES)}, {CURVES} (where the paper has no figure) "
        "or all; default: all",
    )
    result.add_argument(
        "--tag",
        help="use the variants X@TAG instead of the plain ones",
    )
    result.add_argument(
        "--gif",
        nargs="*",
        metavar="VARIANT",
        help="also show a greedy episode of these variants (BC-FQI), or of every "
        "environment's BC- one, else its best",
    )
    result.add_argument(
        "--allow-incomplete",
        action="store_true",
        help="draw what is complete of unfinished runs, and say so in every figure",
    )
    result.add_argument("--out", type=Path, help="default: figures in the runs' folder")
    return result


def report(
    runs: Runs, out: Path, figures: Sequence[str], tag: str | None
) -> tuple[list[Path], list[str]]:
    """Write everything asked for; the files and what had to be skipped, and why."""
    suffix = f"{runs.scale}@{tag}" if tag else runs.scale
    tagged = f"@{tag}" if tag else ""
    files, skipped = [], []
    drawn: Pictures = {}
    for name in figures:
        if name == CURVES:
            continue
        env, experiment, needed, draw = FIGURES[name]
        linear = env == LINEAR
        methods = figure_methods(runs, tag) if linear else runs.methods(env, tag)
        if not methods or (needed and needed not in methods):
            lacking = f"{env}/{needed or '*'}{tagged}"
            remedy = f"`bcrl experiment={experiment} scale={runs.scale}` makes them"
            if tag:
                example = f"`bcrl experiment={experiment}_released scale={runs.scale}`"
                remedy = f"runs with tag={tag} make them, as {example} does"
            skipped.append(f"figure {name}: no runs of {lacking}: {remedy}")
            continue
        with style.sheet():
            title = f"Klink et al. (2022), figure {name}, reproduced: {suffix}"
            saved = style.save(draw(runs, tag), out, f"figure_{name}_{suffix}", title)
        files += saved
        caption = f"Figure {name}. {inspect.getdoc(draw).splitlines()[0]}"
        pair = (env, "DQN" if linear else "FQI")
        drawn.setdefault(pair, []).append(Picture(saved[0], caption))
    curves = draw_curves(runs, out, tag) if CURVES in figures else {}
    files += [path for saved in curves.values() for path in saved]
    families = {variant.family for variant in runs.variants}
    for family, stem in (("FQI", "aggregate"), ("DQN", "aggregate_dqn")):
        if family in families:
            table = aggregate(runs, family)
            files.append(_write_csv(out / f"{stem}_{runs.scale}.csv", table))
    files.append(write_text(out / f"claims_{suffix}.md", claims_report(runs, tag)))
    if compared := groups(runs):
        text = sweep_report(runs, compared)
        files.append(write_text(out / f"sweep_{runs.scale}.md", text))
        table = sweep_table(compared)
        files.append(_write_csv(out / f"sweep_{runs.scale}.csv", table))
    fallback = {
        pair: [
            Picture(png, "Mean over seeds with 95 % intervals.") for png in saved[::2]
        ]
        for pair, saved in curves.items()
    }
    agents = [
        Picture(path, f"{env_title(variant.env)}: {variant.name}")
        for variant in runs.variants
        if tag in (None, variant.tag) and (path := gif_of(runs, variant, out)).exists()
    ]
    text = page(runs, tag, drawn, fallback, agents)
    files.append(write_text(out / f"report_{suffix}.html", text))
    return files, skipped


def draw_curves(
    runs: Runs, out: Path, tag: str | None
) -> dict[tuple[str, str], list[Path]]:
    """Learning curves wherever the paper has no figure: (env, family) → PNG, PDF, ….

    Where there are tagged variants only, a figure a tag.
    """
    files: dict[tuple[str, str], list[Path]] = {}
    for env, family in runs.pairs:
        if (env, family) in COMPARED:
            continue
        tags = dict.fromkeys(variant.tag for variant in runs.of(env, family))
        for shown in [tag] if tag in tags else tags if tag is None else ():
            suffix = f"{runs.scale}@{shown}" if shown else runs.scale
            with style.sheet():
                drawn = figure_curves(runs, env, family, shown)
                title = f"{env}, {family}: learning curves, {suffix}"
                name = f"curves_{env}_{family}_{suffix}"
                saved = style.save(drawn, out, name, title)
            files.setdefault((env, family), []).extend(saved)
    return files


def _write_csv(path: Path, table: pd.DataFrame) -> Path:
    return write_text(path, table.to_csv(index=False, lineterminator="\n"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; 0 if all went well, 2 with one message for what a user can mend."""
    ready()
    try:
        options = parser().asked(arguments)
        chosen = [*FIGURES, CURVES]
        if "all" not in options.figures:
            chosen = list(dict.fromkeys(options.figures))
        runs = load_runs(options.runs_dir, options.scale, options.allow_incomplete)
        for note in runs.notes:
            say(f"note: {note.text}")
        out = options.out or options.runs_dir / "figures"
        make_directory(out, "--out")
        shown, not_shown = [], []
        if options.gif is not None:  # first: the page shows them
            shown, not_shown = animations(runs, out, options.tag, options.gif)
        files, skipped = report(runs, out, chosen, options.tag)
        files, skipped = files + shown, skipped + not_shown
    except BcrlError as error:
        say(f"bcrl-report: {error}")
        return 2
    for line in skipped if options.scale != "search" else ():
        say(f"skipped {line}")
    show("\n".join(map(str, files)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
