"""The paper's claims (claims.yaml): what decides them, verdicts, and a document."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import yaml
from scipy import stats

from bcrl.common.text import ABSENT, duration, estimate, number
from bcrl.report import tables
from bcrl.report.tables import PARAGRAPHS, Section, TextTable
from bcrl.report.variants import Methods, Runs, Variant, incomplete, listed, tags_shown
from bcrl.results import statistics
from bcrl.results.statistics import FEWEST_SEEDS, Interval

_OPTIMAL = 1e-3  # a return this near V*(s0) is optimal: a detour costs 100 times more
_NEAR = 0.01  # a mean return within this share of |V*(s0)| is nearly optimal
#: Metrics that are shown at every stage's end, in words.
_AT_ENDS = {
    "q_error": "Mean error |Q − Q*| in the trained task",
    "solved": "Share of seeds solving the trained task",
    "residual_start": "Mean residual at s0, averaged over actions,",
}


class NotMeasurable(Exception):
    """The runs lack what a claim is about, such as a stage; the message says what."""


def _at(variant: Variant, metric: str, stage: int, row: int = -1) -> np.ndarray:
    """A metric at a row of a stage, the last one by default, (S,)."""
    rows = np.flatnonzero(variant.stage == stage)
    if not len(rows):
        raise NotMeasurable(f"{variant.name} has no stage {stage}")
    return variant.metrics[metric][:, rows[row]]


def _residual(variant: Variant, start: int, end: int) -> np.ndarray:
    """The change of |residual at s0| between two stages' ends, (S,)."""
    before, after = (abs(_at(variant, "residual_start", n)) for n in (start, end))
    return after - before


def _before_target(variant: Variant, metric: str) -> np.ndarray:
    """Mean over the later stages' ends before the target, (S,): T5 to T9 of ten."""
    n = int(variant.stage[-1])
    if n == 1:
        raise NotMeasurable(f"{variant.name} has one stage only")
    return np.mean([_at(variant, metric, k) for k in range(max(1, n // 2), n)], axis=0)


def _gap(variant: Variant) -> np.ndarray:
    """Last return − V*(s0), (S,)."""
    if variant.optimum is None:
        raise NotMeasurable("the runs do not record one optimum")
    return variant.last("return") - variant.optimum


#: The measures of a variant: (S,) values, or hits to be counted.
MEASURES = {
    "error": lambda v: v.last("q_error"),
    "return": lambda v: v.last("return"),
    "deviation of return": lambda v: v.last("return"),
    "solved": lambda v: v.last("solved") > 0,
    "error from T1 to T2": lambda v: _at(v, "q_error", 2, 0) - _at(v, "q_error", 1),
    "error within T3": lambda v: _at(v, "q_error", 3) - _at(v, "q_error", 3, 0),
    "error after T2": lambda v: _at(v, "q_error", 2),
    "error before the target": lambda v: _before_target(v, "q_error"),
    "solved before the target": lambda v: _before_target(v, "solved"),
    "optimal": lambda v: _gap(v) >= -_OPTIMAL,
    "nearly optimal": lambda v: _gap(v) / abs(v.optimum) + _NEAR,
    "residual from T1 to T6": lambda v: _residual(v, 1, 6),
    "residual from T6 to T7": lambda v: _residual(v, 6, 7),
    "residual from T7 to T10": lambda v: _residual(v, 7, 10),
    "late return": lambda v: v.late("return"),
}
#: Verdicts that the page counts, besides `undecided`.
HOLDS, FAILS = "holds", "does not hold"
EXPECTED = "as expected, too few seeds to judge"
UNEXPECTED = "not as expected, too few seeds to judge"

_STATISTICS = {"deviation of return": np.std}  # of others the mean over seeds

_TEXT = Path(__file__).with_name("claims.yaml").read_text("utf-8")
_DATA = yaml.safe_load(_TEXT.format(optimal=_OPTIMAL, near=_NEAR))
_TITLES: dict[str, str] = _DATA["titles"]  # by environment
#: Environment, family → statement → quantity, what is expected of it, and of whom.
CLAIMS: dict[tuple[str, ...], dict[str, list[str]]] = {
    tuple(pair.split(", ")): found for pair, found in _DATA["claims"].items()
}


def claims_report(runs: Runs, tag: str | None, claims: Iterable[Section]) -> str:
    """The Markdown document of the `claims_sections` and the notes on the runs."""
    tagged, notes = f", variants @{tag}" if tag else "", runs.notes_on(tag)
    parts: list[object] = [f"# The paper's claims, scale {runs.scale}{tagged}\n"]
    if lacking := incomplete(notes):
        parts.append(f"**{lacking}**\n")
    words = "".join(f"- *{term}*: {text}\n" for term, text in tables.GLOSSARY.items())
    parts += [PARAGRAPHS["claims"], words, *claims]
    return "\n".join(map(str, [*parts, *tables.notes_section(notes)]))


def claims_sections(runs: Runs, tag: str | None) -> dict[tuple[str, str], Section]:
    """(environment, family) of the paper's that have runs → their claims and values."""
    found = {}
    for (env, family), claims in CLAIMS.items():
        methods = runs.methods(env, tag, family)
        if not methods:
            continue
        variants = methods.values()
        rows = [_judged(text, claim, methods) for text, claim in claims.items()]
        counted = verdict_counts(rows).most_common()
        listing = "; ".join(f"{n} {verdict}" for verdict, n in counted)
        parts = [f"{len(rows)} claims: {listing}.\n", TextTable(rows)]
        if len({variant.tag for variant in variants}) > 1:
            parts.insert(0, f"{tags_shown(methods)}; the others are untagged.\n")
        seconds = duration(sum(variant.cpu_seconds for variant in variants))
        parts += [*_values(variants, family), f"CPU time of these runs: {seconds}.\n"]
        found[env, family] = Section(_TITLES[env], parts)
    return found


def verdict_counts(rows: Iterable[Mapping[str, str]]) -> Counter[str]:
    """How many of the claims' rows have which verdict, its reason left aside."""
    return Counter(re.split(r" \(|:", row["verdict"])[0] for row in rows)


def _judged(statement: str, claim: list[str], runs: Methods) -> dict[str, str]:
    """A claim, what was measured of `runs`, and the verdict: a table's row."""
    quantity, expect, *names = claim
    absent = [name for name in names if name not in runs]
    used = [runs[name] for name in names if name in runs]
    counts = [len(variant.seeds) for variant in used]
    shown, decided = ABSENT, f"no runs of {listed(absent)}" if absent else ""
    try:
        if not absent:
            value, interval, detail = _measured(quantity, used)
            shown = estimate(value, interval) + detail
            decided = verdict(value, interval, expect, min(counts))
    except NotMeasurable as reason:
        decided = f"not measurable: {reason}"
    words = f"{_DATA['quantities'][quantity]}: {' − '.join(names)}"
    return {
        "claim": statement,
        "quantity: method, or difference of two": words,
        "expected": expect,
        "estimate [95 % interval]": shown,
        "seeds": " / ".join(map(str, dict.fromkeys(counts))) or "0",
        "verdict": decided,
    }


def _measured(quantity: str, variants: list[Variant]) -> tuple[float, Interval, str]:
    """An estimate, its interval, and the counts of seeds if it is of shares."""
    values = [MEASURES[quantity](variant) for variant in variants]
    statistic = _STATISTICS.get(quantity, np.mean)
    first, *rest = (float(statistic(each)) for each in values)
    value = first - rest[0] if rest else first
    if values[0].dtype != bool:
        return value, statistics.bootstrap(*values, statistic=statistic), ""
    (hits, n), *others = counts = [(int(v.sum()), len(v)) for v in values]
    if not others:
        return value, statistics.share_interval(hits, n), f" ({hits} of {n} seeds)"
    shown = " against ".join(f"{k}/{n}" for k, n in counts)
    interval = statistics.share_difference_interval(hits, n, *others[0])
    return value, interval, f" ({shown})"


def verdict(value: float, interval: Interval, expect: str, seeds: int) -> str:
    """HOLDS, FAILS or `undecided`; with too few seeds only what the value points to."""
    if not np.isfinite(value):
        return "undecided (non-finite values)"
    few = seeds < FEWEST_SEEDS
    low, high = (value, value) if few else interval
    holds, fails = {
        "= 0": (value == 0, value != 0),
        "> ½": (low > 0.5, high <= 0.5),
        "> 0": (low > 0, high <= 0),
        "< 0": (high < 0, low >= 0),
        "≤ 0": (high <= 0, low > 0),
    }[expect]
    if few:
        return EXPECTED if holds else UNEXPECTED
    return HOLDS if holds else FAILS if fails else "undecided"


def _values(variants: Iterable[Variant], family: str) -> list[str | TextTable]:
    """What every method reaches, and metrics of FQI at every stage's end."""
    common = set.intersection(*(set(v.metrics) for v in variants))
    rows = []
    for variant in variants:
        n, measured = len(variant.seeds), _reached(variant)
        seeds = tables.seeds_cell(n, len(variant.failed))
        row = {"method": variant.name, "seeds": seeds}
        for name, values in measured.items():
            row[name] = estimate(values.mean(), statistics.bootstrap(values))
        for name in ("q_error", "q_error_start", "return", "late return"):
            if name in measured:
                row[f"{name}, IQM"] = number(stats.trim_mean(measured[name], 0.25))
        if "solved" in common:
            hits = int((variant.last("solved") > 0).sum())
            low, high = map(number, statistics.share_interval(hits, n))
            row["seeds solving the target"] = f"{hits}/{n} [{low}, {high}]"
        rows.append(row)
    parts: list[str | TextTable] = [PARAGRAPHS[family], TextTable(rows)]
    stages = range(1, 1 + max(v.stage[-1] for v in variants))
    for metric in (name for name in _AT_ENDS if name in common):
        rows = []
        for v in variants:
            ends = {n: number(_at(v, metric, n).mean()) for n in np.unique(v.stage)}
            row = {f"stage {n}": ends.get(n, ABSENT) for n in stages}
            rows.append({"method": v.name} | row)
        parts += [f"{_AT_ENDS[metric]} at every stage's end:\n", TextTable(rows)]
    return parts


def _reached(variant: Variant) -> dict[str, np.ndarray]:
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
