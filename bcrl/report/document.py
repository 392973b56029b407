"""The claims as a Markdown document, with the values behind them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping

from bcrl.report.claims import car_claims, maze_claims
from bcrl.report.curves import LINEAR, linear_methods
from bcrl.report.linear_claims import LATE, late_table, linear_claims
from bcrl.report.notes import Note, incomplete, tags_shown
from bcrl.report.tables import Section, Table, final_table, stage_table
from bcrl.report.variants import Runs, Variant
from bcrl.report.verdicts import FEWEST_SEEDS, Claim

HEADER = (
    "claim",
    "quantity",
    "expected",
    "estimate [95 % interval]",
    "seeds",
    "verdict",
)
SECTIONS = (
    ("car_on_hill", "Car on the hill (§6.1, Fig. 1)", car_claims),
    ("maze", "Maze (§6.2 and C.2, Figs. 2, 3, 5)", maze_claims),
)
LINEAR_TITLE = "Linear system (§6.3 and C.3, Fig. 4)"
NO_RUNS = "No runs.\n"

PREAMBLE = f"""\
Intervals are 95 %: percentile bootstrap over seeds for means and their differences,
Wilson's and Newcombe's score intervals for shares of seeds. A claim *holds* if the
whole interval agrees with the stated sign, *does not hold* if the whole interval
contradicts it, and is *undecided* otherwise or with fewer than {FEWEST_SEEDS} seeds.
Claims that something never happens are judged by the count. Each claim is judged
by itself, without a correction for their number.
"""


def claims_report(runs: Runs, tag: str | None = None) -> str:
    """The Markdown document: per environment the claims and the values behind them."""
    tagged = f", variants @{tag}" if tag else ""
    notes = notes_of(runs, tag)
    parts = [f"# The paper's claims, scale {runs.scale}{tagged}\n"]
    if lacking := incomplete(notes):
        parts.append(f"**{lacking}**\n")
    parts += [PREAMBLE, *map(str, claims_sections(runs, tag).values())]
    if notes:
        parts.append("## Notes on the runs\n")
        parts.append("\n".join(f"- {note.text}" for note in notes) + "\n")
    return "\n".join(parts)


def notes_of(runs: Runs, tag: str | None) -> list[Note]:
    """The notes on the runs that a document about the variants `tag` shows."""
    linear = linear_methods(runs, tag)
    return [n for n in runs.notes if n.tag == tag or _stands_in(n, linear)]


def claims_sections(runs: Runs, tag: str | None) -> dict[tuple[str, str], Section]:
    """(environment, family) of the paper's → its claims and the values behind them."""
    found = {
        (env, "FQI"): Section(title, _fqi_parts(runs.methods(env, tag), claims))
        for env, title, claims in SECTIONS
    }
    linear = _linear_parts(linear_methods(runs, tag))
    return found | {(LINEAR, "DQN"): Section(LINEAR_TITLE, linear)}


def _fqi_parts(
    methods: Mapping[str, Variant], claims: Callable[[], list[Claim]]
) -> list[str | Table]:
    """The claims about FQI's methods in one environment, and the values."""
    if not methods:
        return [NO_RUNS]
    rows = [claim.row(methods) for claim in claims()]
    return [
        _tally([row[-1] for row in rows]),
        Table(HEADER, rows),
        "After the last iteration (IQM: interquartile mean over seeds):\n",
        final_table(methods),
        *_by_stage(methods),
        _cost(methods),
    ]


def _linear_parts(methods: Mapping[str, Variant]) -> list[str | Table]:
    """The DQN family's claims and values, with who is of which tag."""
    if not methods:
        return [NO_RUNS]
    parts: list[str | Table] = []
    if len({variant.tag for variant in methods.values()}) > 1:
        parts.append(f"{tags_shown(methods)}; the others are untagged.\n")
    rows = [claim.row(methods) for claim in linear_claims()]
    parts += [_tally([row[-1] for row in rows]), Table(HEADER, rows), LATE]
    return [*parts, late_table(methods), _cost(methods)]


def _stands_in(note: Note, linear: Mapping[str, Variant]) -> bool:
    """Whether a note is about an untagged run that stands beside tagged ones."""
    variant = linear.get(note.method or "")
    return variant is not None and (note.env, note.tag) == (variant.env, variant.tag)


def _tally(verdicts: list[str]) -> str:
    """How many claims got which verdict, reasons left aside."""
    counts = Counter(verdict.split(" (")[0].split(":")[0] for verdict in verdicts)
    counted = ", ".join(f"{n} {verdict}" for verdict, n in counts.most_common())
    return f"{len(verdicts)} claims: {counted}.\n"


def _by_stage(methods: Mapping[str, Variant]) -> list[str | Table]:
    """What each stage ended with, so that the course can be followed."""
    parts: list[str | Table] = [
        "Mean error |Q − Q*| in the trained task at every stage's end:\n",
        stage_table(methods, "q_error"),
    ]
    if all("solved" in variant.metrics for variant in methods.values()):
        parts.append("Share of seeds solving the trained task at every stage's end:\n")
        parts.append(stage_table(methods, "solved"))
        parts.append("Mean residual at s0, averaged over actions, at stage ends:\n")
        parts.append(stage_table(methods, "residual_start"))
    return parts


def _cost(methods: Mapping[str, Variant]) -> str:
    seconds = sum(variant.total("cpu_seconds") for variant in methods.values())
    return f"CPU time of these runs: {duration(seconds)}.\n"


def duration(seconds: float) -> str:
    """`1.5 h`, `12 s`."""
    return f"{seconds / 3600:.1f} h" if seconds >= 3600 else f"{seconds:.0f} s"
