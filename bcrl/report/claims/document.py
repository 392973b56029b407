"""The claims as a Markdown document, with the values behind them."""

import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from bcrl.report.claims.judge import CLAIMS, FEWEST_SEEDS, judged
from bcrl.report.notes import incomplete, tags_shown
from bcrl.report.statistics import share_interval
from bcrl.report.tables import (
    ABSENT,
    Section,
    TextTable,
    duration,
    interquartile_mean,
    mean_cell,
    number,
    seeds_cell,
)
from bcrl.report.variants import LINEAR, WINDOW, Note, Runs, Variant

_TITLES = {
    "car_on_hill": "Car on the hill (§6.1, Fig. 1)",
    "maze": "Maze (§6.2 and C.2, Figs. 2, 3, 5)",
    LINEAR: "Linear system (§6.3 and C.3, Fig. 4)",
}

PREAMBLE = f"""\
Intervals are 95 %: percentile bootstrap over seeds for means and their differences,
Wilson's and Newcombe's score intervals for shares of seeds. A claim *holds* if the
whole interval agrees with the stated sign, *does not hold* if the whole interval
contradicts it, and is *undecided* otherwise or with fewer than {FEWEST_SEEDS} seeds.
For claims that something never happens the count decides. Each claim is tested by
itself, without a correction for their number.
"""
_TEXTS = Path(__file__).parents[1] / "templates"
GLOSSARY = (_TEXTS / "glossary.md").read_text("utf-8")
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
    for (env, family), claims in CLAIMS.items():
        methods = runs.methods(env, tag, family)
        if not methods:
            found[env, family] = Section(_TITLES[env], ["No runs.\n"])
            continue
        variants = methods.values()
        parts: list[str | TextTable] = []
        if len({variant.tag for variant in variants}) > 1:
            parts.append(f"{tags_shown(methods)}; the others are untagged.\n")
        rows = [judged(text, claim, methods) for text, claim in claims.items()]
        # Reasons are left aside.
        verdicts = Counter(re.split(r" \(|:", row["verdict"])[0] for row in rows)
        counted = ", ".join(f"{n} {verdict}" for verdict, n in verdicts.most_common())
        parts += [f"{len(rows)} claims: {counted}.\n", TextTable(rows)]
        parts += (_fqi_values if family == "FQI" else _dqn_values)(variants)
        seconds = sum(variant.cpu_seconds for variant in variants)
        parts.append(f"CPU time of these runs: {duration(seconds)}.\n")
        found[env, family] = Section(_TITLES[env], parts)
    return found


def _fqi_values(variants: Iterable[Variant]) -> list[str | TextTable]:
    """Every metric after the last iteration and at every stage's end."""
    common = set.intersection(*(set(v.metrics) for v in variants))
    metrics = [m for m in ("q_error", "q_error_start", "return") if m in common]
    at_ends = {"Mean error |Q − Q*| in the trained task": "q_error"}
    if solves := "solved" in common:
        at_ends |= {
            "Share of seeds solving the trained task": "solved",
            "Mean residual at s0, averaged over actions,": "residual_start",
        }
    rows = []
    for variant in variants:
        n = len(variant.seeds)
        row = {"method": variant.name, "seeds": f"{n}"}
        row |= {m: mean_cell(variant.last(m)) for m in metrics}
        row |= {f"{m}, IQM": interquartile_mean(variant.last(m)) for m in metrics}
        if solves:
            hits = int((variant.last("solved") > 0).sum())
            low, high = map(number, share_interval(hits, n))
            row["seeds solving the target"] = f"{hits}/{n} [{low}, {high}]"
        rows.append(row)
    text = "After the last iteration (IQM: interquartile mean over seeds):\n"
    parts: list[str | TextTable] = [text, TextTable(rows)]
    stages = max(variant.stage[-1] for variant in variants)
    for words, metric in at_ends.items():
        table = TextTable([_at_ends(variant, metric, stages) for variant in variants])
        parts += [f"{words} at every stage's end:\n", table]
    return parts


def _at_ends(variant: Variant, metric: str, stages: int) -> dict[str, str]:
    """A row of a metric's means over seeds at every stage's end."""
    row = {f"stage {stage}": ABSENT for stage in range(1, stages + 1)}
    for at in np.flatnonzero(np.diff(variant.stage, append=0)):
        mean = variant.metrics[metric][:, at].mean()
        row[f"stage {variant.stage[at]}"] = number(mean)
    return {"method": variant.name} | row


def _dqn_values(variants: Iterable[Variant]) -> list[str | TextTable]:
    """The target's values per method at the end, late and over the whole curve."""
    rows = [
        {
            "method": v.name,
            "seeds": seeds_cell(len(v.seeds), len(v.failed)),
            "last return": mean_cell(v.last("return")),
            "late return": mean_cell(v.late("return")),
            "late return, IQM": interquartile_mean(v.late("return")),
            "last discounted return": mean_cell(v.last("discounted_return")),
            "late success rate": mean_cell(v.late("success_rate")),
            "late greedy return": mean_cell(v.late("greedy_return")),
            "area": mean_cell(v.area("return")),
        }
        for v in variants
    ]
    return [_LATE, TextTable(rows)]
