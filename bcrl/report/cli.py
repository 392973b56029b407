"""`bcrl-report`: figures, aggregate and claims from the runs of one scale."""

import inspect
import sys
from argparse import Namespace
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from bcrl.common.files import make_directory, write_text
from bcrl.common.terminal import ready, say, show
from bcrl.errors import BcrlError
from bcrl.report import tables
from bcrl.report.animation import animations, gif_of
from bcrl.report.choose import draw_chosen
from bcrl.report.claims import claims_report, claims_sections
from bcrl.report.figures import curves, linear, maze, style
from bcrl.report.figures.layout import Print, formats, inches, save_figure
from bcrl.report.load import load_runs
from bcrl.report.page import page
from bcrl.report.variants import COMPARED, LINEAR, Pair, Runs, Variant, env_title
from bcrl.results.arguments import ResultsParser
from bcrl.results.layout import INSPECTED, INSPECTION

CAR, MAZE, LQ = ("car_on_hill", "FQI"), ("maze", "FQI"), (LINEAR, "DQN")
#: figure → its runs' environment and family, experiment, method it cannot do without
FIGURES: dict[str, tuple[Pair, str, str | None, Callable[..., Figure]]] = {
    "1": (CAR, "fig1", None, curves.figure_1),
    "2": (MAZE, "fig2", None, curves.figure_2),
    "3": (MAZE, "fig2", None, maze.figure_3),
    "4a": (LQ, "fig4", None, linear.figure_4a),
    "4b": (LQ, "fig4", None, linear.figure_4b),
    "5": (MAZE, "fig2", "BC-FQI", curves.figure_5),
}
#: Options that need --compare or --sweep; those that exclude them, and their defaults.
_CHOOSING = ("env", "metrics", "target_only", "name")
_NOT_CHOOSING = {"figures": ["all"], "tag": None, "gif": None}
CURVES = "curves"  # learning curves of what the paper has no figure of


def _parser() -> ResultsParser:
    """The command line; its help is the reference."""
    about = "Draw figures of finished runs, test the paper's claims, write a page."
    result = ResultsParser("bcrl-report", about)
    add = result.add_argument
    text = "smoke, quick, paper, search or your own; default: %(default)s"
    add("--scale", default="quick", help=text)
    text = f"which of {', '.join(FIGURES)}, {CURVES} (where the paper has no figure) "
    known = {"choices": ["all", *FIGURES, CURVES], "default": ["all"], "metavar": "N"}
    add("--figures", nargs="+", help=f"{text}or all; default: all", **known)
    add("--tag", help="use the variants X@TAG instead of the plain ones")
    text = "also show a greedy episode of these variants, or each environment's best"
    add("--gif", nargs="*", metavar="VARIANT", help=text)
    text = "draw what is complete of unfinished runs, and say so in every figure"
    add("--allow-incomplete", action="store_true", help=text)
    add("--out", type=Path, help="default: figures in the runs' folder")
    text = "column (3.25 in), text (6.75 in) or inches; default: %(default)s"
    add("--width", default="text", help=text)
    text = "kinds of the figures' files, of png, pdf, svg; default: png,pdf"
    add("--format", nargs="+", default=["png,pdf"], metavar="KIND", help=text)
    text = "write the caption to a text file instead of below the figure"
    add("--caption-file", action="store_true", help=text)
    chosen = result.add_argument_group("instead of the report, one figure per metric")
    add = chosen.add_argument
    text = "curves of these variants, such as BC-FQI@mine, 'BC-FQI*' or a folder's path"
    add("--compare", nargs="+", metavar="VARIANT", help=text)
    text = "variants (all, or those of --compare) by the value of a key or of two"
    add("--sweep", nargs="+", metavar="KEY", help=text)
    add("--env", help="their environment, if several have such runs")
    add("--metrics", nargs="+", metavar="METRIC", help="default: all that they have")
    add("--target-only", action="store_true", help="leave the easier tasks out")
    add("--name", help="what the files' names begin with")
    return result


def report(
    runs: Runs, out: Path, figures: Collection[str], tag: str | None, how: Print
) -> tuple[list[Path], list[str]]:
    """Write these figures and all documents: the files, what was skipped and why."""
    how = how._replace(kinds=list(dict.fromkeys(["png", *how.kinds])))  # for the page
    suffix = f"{runs.scale}@{tag}" if tag else runs.scale
    files: list[Path] = []
    skipped, drawn = [], defaultdict(list)

    def save(figure: Figure, name: str, title: str, pair: Pair, caption: str) -> None:
        """Save a figure, and keep its PNG and caption for the page."""
        saved = save_figure(figure, out, name, title, how)
        files.extend(saved)
        drawn[pair].append((saved[0], caption))

    for name, (pair, experiment, needed, draw) in FIGURES.items():
        if name not in figures:
            continue
        methods = runs.compared(pair[0], tag, pair[1])
        if methods and (not needed or needed in methods):
            title = f"Klink et al. (2022), figure {name}, reproduced: {suffix}"
            caption = f"Figure {name}. {inspect.getdoc(draw).splitlines()[0]}"
            save(
                draw(runs, tag, how.width),
                f"figure_{name}_{suffix}",
                title,
                pair,
                caption,
            )
            continue
        lacking = f"{pair[0]}/{needed or '*'}{f'@{tag}' if tag else ''}"
        which = {None: "", "released": "_released"}.get(tag, f" tag={tag}")
        command = f"`bcrl experiment={experiment}{which} scale={runs.scale}`"
        skipped.append(f"figure {name}: no runs of {lacking}: {command} makes them")
    others = [p for p in runs.pairs if p not in COMPARED] if CURVES in figures else []
    for pair in others:
        # Where there are tagged variants only, one figure per tag.
        tags = dict.fromkeys(variant.tag for variant in runs.of(*pair))
        for each in tags if tag is None and None not in tags else tags.keys() & {tag}:
            place = f"{runs.scale}@{each}" if each else runs.scale
            title = f"{', '.join(pair)}: learning curves, {place}"
            caption = "Mean over seeds with 95 % intervals."
            figure = curves.figure_curves(runs, *pair, each, how.width)
            save(figure, "_".join(["curves", *pair, place]), title, pair, caption)

    def write(name: str, text: str | pd.DataFrame) -> None:
        if isinstance(text, pd.DataFrame):
            text = text.to_csv(index=False, lineterminator="\n")
        files.append(write_text(out / name, text))

    for family, kind in (("FQI", ""), ("DQN", "dqn_")):
        if any(variant.family == family for variant in runs.variants):
            end = f"{kind}{runs.scale}.csv"
            write(f"aggregate_{end}", tables.aggregate(runs, family))
            write(f"finals_{end}", tables.finals(runs, family))
    claims, compared = claims_sections(runs, tag), tables.sweep_table(runs)
    if claims:
        write(f"claims_{suffix}.md", claims_report(runs, tag, claims.values()))
    if sweeps := tables.sweep_sections(compared):
        ours = compared.groupby(["env", "method"]).groups
        notes = [note for note in runs.notes if (note.env, note.method) in ours]
        title = f"# Variants compared, scale {runs.scale}\n"
        head = [title, tables.PARAGRAPHS["sweeps"]]
        text = "\n".join(map(str, [*head, *sweeps, *tables.notes_section(notes)]))
        write(f"sweep_{runs.scale}.md", text)
        write(f"sweep_{runs.scale}.csv", compared)
    agents = [
        (path, f"{env_title(variant.env)}: {variant.name}")
        for variant in runs.variants
        if tag in (None, variant.tag) and (path := gif_of(runs, variant, out)).exists()
    ]
    found = inspected(v for v in runs.variants if tag in (None, v.tag))
    write(
        f"report_{suffix}.html", page(runs, tag, drawn, agents, claims, sweeps, found)
    )
    return files, skipped


def inspected(variants: Iterable[Variant]) -> list[tuple[Path, str]]:
    """The figures that `bcrl-inspect` has left in the variants' folders."""
    return [
        (path, f"{env_title(variant.env)}: {variant.name}, {words}")
        for variant in variants
        for name, words in INSPECTED.items()
        if (path := variant.folder / INSPECTION / f"{name}.png").exists()
    ]


def _draw_chosen(options: Namespace, how: Print) -> int:
    """Draw what --compare and --sweep ask for."""
    for name, usual in _NOT_CHOOSING.items():
        if getattr(options, name) != usual:
            text = "cannot be combined with --compare or --sweep"
            raise BcrlError(f"--{name}: {text}; name a tagged variant BC-FQI@TAG")
    out = options.out or options.runs_dir / "figures"
    make_directory(out, "--out")
    with style.sheet():
        files = draw_chosen(options, out, how)
    show("\n".join(map(str, files)))
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; 0 if all went well, 2 with one message for what a user can mend."""
    ready()
    try:
        options = _parser().parsed(arguments)
        how = Print(
            inches(options.width), formats(options.format), options.caption_file
        )
        if options.compare or options.sweep:
            return _draw_chosen(options, how)
        if alone := [name for name in _CHOOSING if getattr(options, name)]:
            flag = f"--{alone[0].replace('_', '-')}"
            why = "needs --compare or --sweep; see bcrl-report --help"
            raise BcrlError(f"{flag}: {why}")
        chosen = [*FIGURES, CURVES] if "all" in options.figures else options.figures
        runs = load_runs(options.runs_dir, options.scale, options.allow_incomplete)
        for note in runs.notes:
            say(f"note: {note.text}")
        out = options.out or options.runs_dir / "figures"
        make_directory(out, "--out")
        shown, not_shown = [], []
        if options.gif is not None:  # first: the page shows them
            shown, not_shown = animations(runs, out, options.tag, options.gif)
        with style.sheet():
            files, skipped = report(runs, out, chosen, options.tag, how)
    except BcrlError as error:
        say(f"bcrl-report: {error}")
        return 2
    for line in (skipped if "all" not in options.figures else []) + not_shown:
        say(f"skipped {line}")
    show("\n".join(map(str, files + shown)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
