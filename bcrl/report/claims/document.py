"""The claims as a Markdown document, with the values behind them."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from bcrl.report.claims.judge import FEWEST_SEEDS
from bcrl.report.claims.paper import CAR_CLAIMS, LINEAR_CLAIMS, MAZE_CLAIMS
from bcrl.report.late import LINEAR, WINDOW, area, late
from bcrl.report.notes import incomplete, tags_shown
from bcrl.report.statistics import interquartile_mean, share_interval
from bcrl.report.tables import (
    ABSENT,
    Section,
    TextTable,
    by_method,
    duration,
    mean_cell,
    number,
    seeds_cell,
)
from bcrl.report.variants import Methods, Note, Runs, Variant

HEADER = (
    *("claim", "quantity: method, or difference of two", "expected"),
    *("estimate [95 % interval]", "seeds", "verdict"),
)
SECTIONS = {
    ("car_on_hill", "FQI"): ("Car on the hill (§6.1, Fig. 1)", CAR_CLAIMS),
    ("maze", "FQI"): ("Maze (§6.2 and C.2, Figs. 2, 3, 5)", MAZE_CLAIMS),
    (LINEAR, "DQN"): ("Linear system (§6.3 and C.3, Fig. 4)", LINEAR_CLAIMS),
}

PREAMBLE = f"""\
Intervals are 95 %: percentile bootstrap over seeds for means and their differences,
Wilson's and Newcombe's score intervals for shares of seeds. A claim *holds* if the
whole interval agrees with the stated sign, *does not hold* if the whole interval
contradicts it, and is *undecided* otherwise or with fewer than {FEWEST_SEEDS} seeds.
For claims that something never happens the count decides. Each claim is tested by
itself, without a correction for their number.
"""
GLOSSARY = """\
*T1*, *T2*, …: the tasks of the curriculum, the target last. *s0*: the state in which
episodes start. `Q*`, `V*`: values of an optimal policy; the *optimum* is `V*(s0)` of
the target. *ϱ*: the residual, what a stage adds to the Q-function of the stage before.
*C-*: with a curriculum; *B-*: boosted; *S-*: with shaped rewards; *RPL*: residual
policy learning; *PPR*: probabilistic policy reuse. *LQ*: the linear-quadratic task
that comes first in the linear system; *LSPI*: least-squares policy iteration. *IQM*:
interquartile mean. *@released*: settings of the authors' released code.
"""
_LATE = f"""\
All returns are the target task's. *Late*: a seed's mean over the evaluations of its
last {WINDOW} environment steps; *area*: its mean over all evaluations in the target.
Both are of the exploring policy and undiscounted, unless a column says otherwise.
"""


def claims_report(runs: Runs, tag: str | None = None) -> str:
    """The Markdown document: per environment the claims and the values behind them."""
    tagged = f", variants @{tag}" if tag else ""
    notes = notes_of(runs, tag)
    parts = [f"# The paper's claims, scale {runs.scale}{tagged}\n"]
    if lacking := incomplete(notes):
        parts.append(f"**{lacking}**\n")
    parts += [PREAMBLE, GLOSSARY, *map(str, claims_sections(runs, tag).values())]
    if notes:
        parts.append("## Notes on the runs\n")
        parts.append("\n".join(f"- {note.text}" for note in notes) + "\n")
    return "\n".join(parts)


def notes_of(runs: Runs, tag: str | None) -> list[Note]:
    """The notes for a document about the variants `tag` and those that stand in."""
    linear = runs.methods(LINEAR, tag, "DQN").values()
    drawn = {(v.env, v.method, v.tag) for v in linear}
    return [n for n in runs.notes if n.tag == tag or (n.env, n.method, n.tag) in drawn]


def claims_sections(runs: Runs, tag: str | None) -> dict[tuple[str, str], Section]:
    """(environment, family) of the paper's → its claims and the values behind them."""
    found = {}
    for (env, family), (title, claims) in SECTIONS.items():
        methods = runs.methods(env, tag, family)
        parts: list[str | TextTable] = []
        if len({variant.tag for variant in methods.values()}) > 1:
            parts.append(f"{tags_shown(methods)}; the others are untagged.\n")
        rows = [claim.row(methods) for claim in claims]
        parts += [_tally([row[-1] for row in rows]), TextTable(HEADER, rows)]
        parts += _fqi_values(methods) if family == "FQI" else _dqn_values(methods)
        seconds = sum(variant.cpu_seconds for variant in methods.values())
        parts.append(f"CPU time of these runs: {duration(seconds)}.\n")
        found[env, family] = Section(title, parts if methods else ["No runs.\n"])
    return found


def _tally(verdicts: list[str]) -> str:
    """How many claims got which verdict, reasons left aside."""
    counts = Counter(verdict.split(" (")[0].split(":")[0] for verdict in verdicts)
    counted = ", ".join(f"{n} {verdict}" for verdict, n in counts.most_common())
    return f"{len(verdicts)} claims: {counted}.\n"


def _fqi_values(methods: Methods) -> list[str | TextTable]:
    """Every metric after the last iteration and at every stage's end."""
    if not methods:
        return []
    common = set.intersection(*(set(v.metrics) for v in methods.values()))
    metrics = [m for m in ("q_error", "q_error_start", "return") if m in common]
    columns = {"seeds": lambda v: str(len(v.seeds))}
    columns |= {m: lambda v, m=m: mean_cell(v.last(m)) for m in metrics}
    columns |= {f"{m}, IQM": lambda v, m=m: _iqm(v.last(m)) for m in metrics}
    at_ends = {"Mean error |Q − Q*| in the trained task": "q_error"}
    if "solved" in common:
        columns["seeds solving the target"] = _solved_cell
        at_ends |= {
            "Share of seeds solving the trained task": "solved",
            "Mean residual at s0, averaged over actions,": "residual_start",
        }
    parts: list[str | TextTable] = [
        "After the last iteration (IQM: interquartile mean over seeds):\n",
        by_method(methods, columns),
    ]
    stages = range(1, 1 + max(int(v.stage[-1]) for v in methods.values()))
    for words, metric in at_ends.items():
        columns = {
            f"stage {stage}": lambda v, m=metric, stage=stage: _end_cell(v, m, stage)
            for stage in stages
        }
        parts += [f"{words} at every stage's end:\n", by_method(methods, columns)]
    return parts


def _end_cell(variant: Variant, metric: str, stage: int) -> str:
    rows = variant.rows(stage)
    return number(variant.metrics[metric][:, rows[-1]].mean()) if len(rows) else ABSENT


def _solved_cell(variant: Variant) -> str:
    hits, n = int((variant.last("solved") > 0).sum()), len(variant.seeds)
    low, high = map(number, share_interval(hits, n))
    return f"{hits}/{n} [{low}, {high}]"


def _iqm(values: NDArray[np.float64]) -> str:
    return number(interquartile_mean(values))


def _dqn_values(methods: Methods) -> list[str | TextTable]:
    """The target's values per method at the end, late and over the whole curve."""
    columns = {
        "seeds": seeds_cell,
        "last return": lambda v: mean_cell(v.last("return")),
        "late return": lambda v: mean_cell(late(v, "return")),
        "late return, IQM": lambda v: _iqm(late(v, "return")),
        "last discounted return": lambda v: mean_cell(v.last("discounted_return")),
        "late success rate": lambda v: mean_cell(late(v, "success_rate")),
        "late greedy return": lambda v: mean_cell(late(v, "greedy_return")),
        "area": lambda v: mean_cell(area(v, "return")),
    }
    return [_LATE, by_method(methods, columns)]
