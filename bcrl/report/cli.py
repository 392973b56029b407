"""`bcrl-report`: figures, aggregate and claims from the runs of one scale."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from bcrl.common.files import make_directory, write_text
from bcrl.common.terminal import ready, say, show
from bcrl.errors import BcrlError
from bcrl.report.animation import animations, gif_of
from bcrl.report.claims.document import claims_report
from bcrl.report.figures import style
from bcrl.report.figures.curves import figure_1, figure_2, figure_5, figure_curves
from bcrl.report.figures.linear import figure_4a, figure_4b
from bcrl.report.figures.maze import figure_3
from bcrl.report.late import LINEAR
from bcrl.report.load import load_runs
from bcrl.report.page import Picture, Pictures, page
from bcrl.report.sweeps import groups, sweep_report, sweep_table
from bcrl.report.tables import aggregate
from bcrl.report.variants import COMPARED, Runs, env_title
from bcrl.results.arguments import ResultsParser

CAR, MAZE, LQ = ("car_on_hill", "FQI"), ("maze", "FQI"), (LINEAR, "DQN")
#: figure → its runs' environment and family, experiment, method it cannot do without
FIGURES: dict[str, tuple[tuple[str, str], str, str | None, Callable[..., Figure]]] = {
    "1": (CAR, "fig1", None, figure_1),
    "2": (MAZE, "fig2", None, figure_2),
    "3": (MAZE, "fig2", None, figure_3),
    "4a": (LQ, "fig4", None, figure_4a),
    "4b": (LQ, "fig4", None, figure_4b),
    "5": (MAZE, "fig2", "BC-FQI", figure_5),
}
CURVES = "curves"  # learning curves of what the paper has no figure of


def parser() -> ResultsParser:
    """The command line; its help is the reference."""
    result = ResultsParser(
        prog="bcrl-report",
        description="Draw figures of finished runs, test the paper's claims, and show "
        "all of it on one HTML page.",
    )
    add = result.add_argument
    which = "smoke, quick, paper, search or your own; default: %(default)s"
    add("--scale", default="quick", help=which)
    add(
        "--figures",
        nargs="+",
        default=["all"],
        choices=["all", *FIGURES, CURVES],
        metavar="N",
        help=f"which of {', '.join(FIGURES)}, {CURVES} (where the paper has no figure) "
        "or all; default: all",
    )
    add("--tag", help="use the variants X@TAG instead of the plain ones")
    add(
        "--gif",
        nargs="*",
        metavar="VARIANT",
        help="also show a greedy episode of these variants (BC-FQI), or of every "
        "environment's BC- one, else its best",
    )
    add(
        "--allow-incomplete",
        action="store_true",
        help="draw what is complete of unfinished runs, and say so in every figure",
    )
    add("--out", type=Path, help="default: figures in the runs' folder")
    return result


def report(
    runs: Runs, out: Path, figures: Sequence[str], tag: str | None
) -> tuple[list[Path], list[str]]:
    """Write what `figures` names and all tables and documents.

    The files, and what was skipped and why.
    """
    suffix = f"{runs.scale}@{tag}" if tag else runs.scale
    files, skipped = [], []
    drawn: Pictures = {}
    for name in figures:
        if name == CURVES:
            continue
        pair, experiment, needed, draw = FIGURES[name]
        methods = runs.compared(pair[0], tag, pair[1])
        if not methods or (needed and needed not in methods):
            lacking = f"{pair[0]}/{needed or '*'}{f'@{tag}' if tag else ''}"
            remedy = f"`bcrl experiment={experiment} scale={runs.scale}` makes them"
            if tag:
                example = f"`bcrl experiment={experiment}_released scale={runs.scale}`"
                remedy = f"runs with tag={tag} make them, as {example} does"
            skipped.append(f"figure {name}: no runs of {lacking}: {remedy}")
            continue
        title = f"Klink et al. (2022), figure {name}, reproduced: {suffix}"
        saved = _save(out, f"figure_{name}_{suffix}", title, draw, runs, tag)
        caption = f"Figure {name}. {inspect.getdoc(draw).splitlines()[0]}"
        drawn.setdefault(pair, []).append(Picture(saved[0], caption))
        files += saved
    fallback = _draw_curves(runs, out, tag, files) if CURVES in figures else {}
    for family, stem in (("FQI", "aggregate"), ("DQN", "aggregate_dqn")):
        if family in {variant.family for variant in runs.variants}:
            text = aggregate(runs, family).to_csv(index=False, lineterminator="\n")
            files.append(write_text(out / f"{stem}_{runs.scale}.csv", text))
    files.append(write_text(out / f"claims_{suffix}.md", claims_report(runs, tag)))
    if compared := groups(runs):
        text = sweep_report(runs, compared)
        files.append(write_text(out / f"sweep_{runs.scale}.md", text))
        text = sweep_table(compared).to_csv(index=False, lineterminator="\n")
        files.append(write_text(out / f"sweep_{runs.scale}.csv", text))
    agents = [
        Picture(path, f"{env_title(variant.env)}: {variant.name}")
        for variant in runs.variants
        if tag in (None, variant.tag) and (path := gif_of(runs, variant, out)).exists()
    ]
    text = page(runs, tag, drawn, fallback, agents)
    files.append(write_text(out / f"report_{suffix}.html", text))
    return files, skipped


def _save(
    out: Path, name: str, title: str, draw: Callable[..., Figure], *of: object
) -> list[Path]:
    with style.sheet():
        return style.save_figure(draw(*of), out, name, title)


def _draw_curves(runs: Runs, out: Path, tag: str | None, files: list[Path]) -> Pictures:
    """Learning curves wherever the paper has no figure, added to `files`.

    Where there are tagged variants only, one figure per tag.
    """
    pictures: Pictures = {}
    for env, family in (pair for pair in runs.pairs if pair not in COMPARED):
        tags = dict.fromkeys(variant.tag for variant in runs.of(env, family))
        for shown in [tag] if tag in tags else tags if tag is None else ():
            suffix = f"{runs.scale}@{shown}" if shown else runs.scale
            name = f"curves_{env}_{family}_{suffix}"
            title = f"{env}, {family}: learning curves, {suffix}"
            saved = _save(out, name, title, figure_curves, runs, env, family, shown)
            picture = Picture(saved[0], "Mean over seeds with 95 % intervals.")
            pictures.setdefault((env, family), []).append(picture)
            files += saved
    return pictures


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; 0 if all went well, 2 with one message for what a user can mend."""
    ready()
    try:
        options = parser().parsed(arguments)
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
    except BcrlError as error:
        say(f"bcrl-report: {error}")
        return 2
    for line in skipped + not_shown if options.scale != "search" else ():
        say(f"skipped {line}")
    show("\n".join(map(str, files + shown)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
