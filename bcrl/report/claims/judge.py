"""The paper's claims (claims.yaml): what decides them, and how they get a verdict."""

from pathlib import Path

import numpy as np
import yaml

from bcrl.report import statistics
from bcrl.report.notes import listed
from bcrl.report.statistics import FEWEST_SEEDS, Interval
from bcrl.report.tables import ABSENT, estimate
from bcrl.report.variants import Methods, Variant

_OPTIMAL = 1e-3  # a return this near V*(s0) is optimal: a detour costs 100 times more
_NEAR = 0.01  # a mean return within this share of |V*(s0)| is nearly optimal


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
    """Mean of a metric over the ends of the stages before the target, (S,). Those of
    the curriculum's second half: T5 to T9 of ten tasks."""
    n = int(variant.stage[-1])
    if n == 1:
        raise NotMeasurable(f"{variant.name} has one stage only")
    ends = [_at(variant, metric, stage) for stage in range(max(1, n // 2), n)]
    return np.mean(ends, axis=0)


def _gap(variant: Variant) -> np.ndarray:
    """Last return − V*(s0), (S,)."""
    if variant.optimum is None:
        raise NotMeasurable("the runs do not record one optimum")
    return variant.last("return") - variant.optimum


#: What is measured of a variant: (S,) values, or hits to be counted.
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
_STATISTICS = {"deviation of return": np.std}  # of others the mean over seeds

_DATA = yaml.safe_load(Path(__file__).with_name("claims.yaml").read_text("utf-8"))
TITLES: dict[str, str] = _DATA["titles"]  # by environment
#: Environment, family → statement → quantity, what is expected of it, and of whom.
CLAIMS: dict[tuple[str, ...], dict[str, list[str]]] = {
    tuple(pair.split(", ")): found for pair, found in _DATA["claims"].items()
}


def judged(statement: str, claim: list[str], runs: Methods) -> dict[str, str]:
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
    if others:
        shown = " against ".join(f"{k}/{n}" for k, n in counts)
        interval = statistics.share_difference_interval(hits, n, *others[0])
        return value, interval, f" ({shown})"
    return value, statistics.share_interval(hits, n), f" ({hits} of {n} seeds)"


def verdict(value: float, interval: Interval, expect: str, seeds: int) -> str:
    """`holds`, `does not hold` or `undecided`, with the reason for no verdict."""
    if not np.isfinite(value):
        return "undecided (non-finite values)"
    if seeds < FEWEST_SEEDS:
        return f"undecided (fewer than {FEWEST_SEEDS} seeds)"
    low, high = interval
    holds, fails = {
        "= 0": (value == 0, value != 0),
        "> ½": (low > 0.5, high <= 0.5),
        "> 0": (low > 0, high <= 0),
        "< 0": (high < 0, low >= 0),
        "≤ 0": (high <= 0, low > 0),
    }[expect]
    return "holds" if holds else "does not hold" if fails else "undecided"
