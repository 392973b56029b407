"""The claims as a Markdown document, with the values behind them."""

import re
from collections import Counter
from collections.abc import Iterable

import numpy as np

from bcrl.report import tables
from bcrl.report.claims.judge import CLAIMS, TITLES, judged
from bcrl.report.notes import incomplete, tags_shown
from bcrl.report.statistics import share_interval
from bcrl.report.tables import ABSENT, TEXTS, Section, TextTable, number
from bcrl.report.variants import LINEAR, Note, Runs, Variant

#: Columns that come with the interquartile mean.
_WITH_IQM = ("q_error", "q_error_start", "return", "late return")
#: Metrics that are shown at every stage's end, in words.
_AT_ENDS = {
    "q_error": "Mean error |Q − Q*| in the trained task",
    "solved": "Share of seeds solving the trained task",
    "residual_start": "Mean residual at s0, averaged over actions,",
}


def claims_report(runs: Runs, tag: str | None = None) -> str:
    """The Markdown document: per environment the claims and the values behind them."""
    tagged = f", variants @{tag}" if tag else ""
    notes = notes_of(runs, tag)
    parts = [f"# The paper's claims, scale {runs.scale}{tagged}\n"]
    if lacking := incomplete(notes):
        parts.append(f"**{lacking}**\n")
    sections = claims_sections(runs, tag).values()
    parts += [TEXTS["claims"], TEXTS["glossary"], *map(str, sections)]
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
            found[env, family] = Section(TITLES[env], ["No runs.\n"])
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
        parts += _values(variants)
        seconds = sum(variant.cpu_seconds for variant in variants)
        parts.append(f"CPU time of these runs: {tables.duration(seconds)}.\n")
        found[env, family] = Section(TITLES[env], parts)
    return found


def _values(variants: Iterable[Variant]) -> list[str | TextTable]:
    """What every method reaches, and metrics of FQI at every stage's end."""
    common = set.intersection(*(set(v.metrics) for v in variants))
    rows = []
    for variant in variants:
        n, failed = len(variant.seeds), len(variant.failed)
        measured = _measured(variant)
        row = {"method": variant.name, "seeds": tables.seeds_cell(n, failed)}
        row |= {name: tables.mean_cell(values) for name, values in measured.items()}
        for name in (name for name in _WITH_IQM if name in measured):
            row[f"{name}, IQM"] = tables.interquartile_mean(measured[name])
        if "solved" in common:
            hits = int((variant.last("solved") > 0).sum())
            low, high = map(number, share_interval(hits, n))
            row["seeds solving the target"] = f"{hits}/{n} [{low}, {high}]"
        rows.append(row)
    parts: list[str | TextTable] = [TEXTS[variant.family], TextTable(rows)]
    stages = max(variant.stage[-1] for variant in variants)
    for metric in (name for name in _AT_ENDS if name in common):
        table = TextTable([_at_ends(variant, metric, stages) for variant in variants])
        parts += [f"{_AT_ENDS[metric]} at every stage's end:\n", table]
    return parts


def _measured(variant: Variant) -> dict[str, np.ndarray]:
    """Columns of the values' table, (S,) each."""
    if variant.family == "FQI":
        names = ("q_error", "q_error_start", "return")
        return {name: variant.last(name) for name in names if name in variant.metrics}
    return {
        "last return": variant.last("return"),
        "late return": variant.late("return"),
        "last discounted return": variant.last("discounted_return"),
        "late success rate": variant.late("success_rate"),
        "late greedy return": variant.late("greedy_return"),
        "area": variant.area("return"),
    }


def _at_ends(variant: Variant, metric: str, stages: int) -> dict[str, str]:
    """A row of a metric's means over seeds at every stage's end."""
    row = {f"stage {stage}": ABSENT for stage in range(1, stages + 1)}
    for at in np.flatnonzero(np.diff(variant.stage, append=0)):
        mean = variant.metrics[metric][:, at].mean()
        row[f"stage {variant.stage[at]}"] = number(mean)
    return {"method": variant.name} | row
