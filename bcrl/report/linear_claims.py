"""The paper's claims about the linear system (§6.3, C.3), judged, and their values."""

from __future__ import annotations

from collections.abc import Mapping

from bcrl.report.curves import WINDOW, area, last, late
from bcrl.report.statistics import interquartile_mean
from bcrl.report.tables import Table, mean_cell, number
from bcrl.report.variants import Variant
from bcrl.report.verdicts import Claim, Measured, between

LATE = f"""\
All returns are the target task's. *Late*: a seed's mean over the evaluations of its
last {WINDOW} environment steps; *area*: its mean over all evaluations in the target.
Both are of the exploring policy and undiscounted, unless a column says otherwise.
"""


def _late_difference(a: Variant, b: Variant) -> Measured:
    return between(late(a, "return"), late(b, "return"))


def _compare(a: str, words: str, b: str, expect: str) -> Claim:
    quantity = f"late return of {a} − that of {b}"
    return Claim(f"{a} {words} {b}", quantity, expect, (a, b), _late_difference)


def linear_claims() -> list[Claim]:
    """What §6.3 and C.3 read off Figure 4."""
    better, not_better = ("ends better than", "> 0"), ("does not improve on", "≤ 0")
    return [
        _compare(a, words, b, expect)
        for a, (words, expect), b in (
            ("BC-DQN", better, "DQN"),
            ("BC-DQN", better, "C-DQN"),
            ("C-DQN", not_better, "DQN"),
            ("RPL", not_better, "DQN"),
            ("PPR", not_better, "DQN"),
            ("SC-DQN", better, "DQN"),
            ("SBC-DQN", better, "SC-DQN"),
            ("SBC-DQN", better, "DQN"),
        )
    ]


def seeds_cell(variant: Variant) -> str:
    """`100`, or `97 (3 failed)` if some diverged."""
    failed = f" ({len(variant.failed)} failed)" if variant.failed else ""
    return f"{len(variant.seeds)}{failed}"


def late_table(methods: Mapping[str, Variant]) -> Table:
    """The target's values per method at the end, late and over the whole curve."""
    header = (
        *("method", "seeds", "last return", "late return", "late return, IQM"),
        *("last discounted return", "late success rate", "late greedy return", "area"),
    )
    rows = [
        [
            variant.name,
            seeds_cell(variant),
            mean_cell(last(variant, "return")),
            mean_cell(late(variant, "return")),
            number(interquartile_mean(late(variant, "return"))),
            mean_cell(last(variant, "discounted_return")),
            mean_cell(late(variant, "success_rate")),
            mean_cell(late(variant, "greedy_return")),
            mean_cell(area(variant, "return")),
        ]
        for variant in methods.values()
    ]
    return Table(header, rows)
