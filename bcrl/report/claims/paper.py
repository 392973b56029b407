"""The paper's claims about car on the hill, the maze and the linear system."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bcrl.report.claims.judge import (
    Claim,
    Measured,
    NotMeasurable,
    between,
    share,
    share_difference,
    within,
)
from bcrl.report.late import late
from bcrl.report.variants import METHODS, Variant

OPTIMAL = 1e-3  # a return this near V*(s0) is optimal: a detour costs 100 times more
NEAR = 0.01  # a mean return within this share of |V*(s0)| is nearly optimal
BC, C, B = "BC-FQI", "C-FQI", "B-FQI"
FIRST, LAST = 0, -1  # iteration of a stage


def _at(variant: Variant, metric: str, stage: int, row: int = LAST) -> NDArray:
    """A metric at a stage's first or last iteration, (S,)."""
    rows = variant.rows(stage)
    if not len(rows):
        raise NotMeasurable(f"{variant.name} has no stage {stage}")
    return variant.metrics[metric][:, rows[row]]


def _switch(variant: Variant) -> NDArray[np.float64]:
    """Change of the error from T1's last iteration to T2's first, (S,)."""
    return _at(variant, "q_error", 2, FIRST) - _at(variant, "q_error", 1)


def _target(variant: Variant) -> NDArray[np.float64]:
    """Change of the error from T3's first iteration to its last, (S,)."""
    return _at(variant, "q_error", 3) - _at(variant, "q_error", 3, FIRST)


def _best() -> list[Claim]:
    """BC-FQI ends with the smallest error and the largest return of all methods."""
    return [
        Claim(
            f"BC-FQI ends with {words} than {other}",
            f"{metric} of BC-FQI − that of {other}, last iteration",
            expect,
            (BC, other),
            lambda a, b, metric=metric: between(a.last(metric), b.last(metric)),
        )
        for metric, words, expect in (
            ("q_error", "a smaller error", "< 0"),
            ("return", "a larger return", "> 0"),
        )
        for other in METHODS
        if other != BC
    ]


def car_claims() -> list[Claim]:
    """What §6.1 reads off Figure 1."""
    switch = "change of q_error from T1's last to T2's first iteration"
    target = "change of q_error from T3's first to its last iteration"
    changes = (
        ("C-FQI's error jumps from T1 to T2", switch, "> 0", C, _switch),
        ("BC-FQI's error does not rise from T1 to T2", switch, "≤ 0", BC, _switch),
        ("BC-FQI's error falls on the target task", target, "< 0", BC, _target),
        ("C-FQI's error rises on the target task", target, "> 0", C, _target),
    )
    single = [
        Claim(words, f"{what}, {name}", expect, (name,), lambda v, of=of: within(of(v)))
        for words, what, expect, name, of in changes
    ]
    both = Claim(
        "BC-FQI's change from T1 to T2 is smaller than C-FQI's",
        f"{switch}, BC-FQI − C-FQI",
        "< 0",
        (BC, C),
        lambda bc, c: between(_switch(bc), _switch(c)),
    )
    end = Claim(
        "when T2 ends BC-FQI's error is smaller than B-FQI's",
        "q_error of BC-FQI − that of B-FQI, end of stage 2",
        "< 0",
        (BC, B),
        lambda bc, b: between(_at(bc, "q_error", 2), _at(b, "q_error", 2)),
    )
    return [*_best(), *single[:2], both, *single[2:], end]


def _before_target(variant: Variant, metric: str) -> NDArray[np.float64]:
    """Mean of a metric over the ends of the stages before the target, (S,).

    Those of the curriculum's second half: T5 to T9 of ten tasks.
    """
    n = int(variant.stage[-1])
    ends = [_at(variant, metric, stage) for stage in range(max(1, n // 2), n)]
    if not ends:
        raise NotMeasurable(f"{variant.name} has one stage only")
    return np.mean(ends, axis=0)


def _solved(variant: Variant) -> NDArray[np.bool_]:
    return variant.last("solved") > 0


def _never(variant: Variant) -> Measured:
    ever = int((variant.metrics["solved"] > 0).any(axis=1).sum())
    return share(_solved(variant), f"; {ever} at any iteration")


def _optimum(variant: Variant) -> float:
    if variant.optimum is None:
        raise NotMeasurable("the runs do not record one optimum")
    return variant.optimum


def _above_near(variant: Variant) -> Measured:
    optimum, returns = _optimum(variant), variant.last("return")
    detail = f" (mean return {returns.mean():.3f}, optimum {optimum:.3f})"
    gap = (returns - optimum) / abs(optimum) + NEAR
    return within(gap, detail.replace("-", "−"))


def _residual_change(variant: Variant, start: int, end: int) -> Measured:
    """Change of |residual at s0| between two stages' ends."""
    before, after = (abs(_at(variant, "residual_start", n)) for n in (start, end))
    return within(after - before, f" ({before.mean():.3g} → {after.mean():.3g})")


def maze_claims() -> list[Claim]:
    """What §6.2 and C.2 read off Figures 2, 3 and 5."""
    half = "mean over stage ends before the target (T5 to T9)"
    never = [
        Claim(
            f"{name} never solves the target",
            "share of seeds solving it after the last iteration",
            "= 0",
            (name,),
            _never,
        )
        for name in ("FQI", B)
    ]
    worse = [
        Claim(
            f"C-FQI deteriorates before the target: {words}",
            f"{what}, {half}",
            expect,
            (C, BC),
            lambda *of, m=metric: between(*(_before_target(v, m) for v in of)),
        )
        for words, what, expect, metric in (
            ("its error", "exact q_error of C-FQI − that of BC-FQI", "> 0", "q_error"),
            ("tasks solved", "share solved by C-FQI − that by BC-FQI", "< 0", "solved"),
        )
    ]
    unreliable = "C-FQI ends unreliable: "
    ends = [
        Claim(
            f"{unreliable}fewer seeds solve the target",
            "share of seeds, C-FQI − BC-FQI, last iteration",
            "< 0",
            (C, BC),
            lambda c, bc: share_difference(_solved(c), _solved(bc)),
        ),
        Claim(
            f"{unreliable}its return varies more between seeds",
            "standard deviation of the return, C-FQI − BC-FQI, last iteration",
            "> 0",
            (C, BC),
            lambda c, bc: between(c.last("return"), bc.last("return"), np.std),
        ),
        Claim(
            "BC-FQI learns an optimal policy: most seeds are at the optimum",
            f"share of seeds whose return is within {OPTIMAL:g} of V*(s0)",
            "> ½",
            (BC,),
            lambda bc: share(bc.last("return") >= _optimum(bc) - OPTIMAL),
        ),
        Claim(
            f"BC-FQI's mean return is within {NEAR:.0%} of the optimum",
            f"(return − V*(s0)) / |V*(s0)| + {NEAR:g}, last iteration",
            "> 0",
            (BC,),
            _above_near,
        ),
    ]
    residual = [
        Claim(
            f"BC-FQI's residual at s0 {words}",
            f"change of |residual at s0|, end of T{end} − end of T{start}",
            expect,
            (BC,),
            lambda bc, start=start, end=end: _residual_change(bc, start, end),
        )
        for words, start, end, expect in (
            ("shrinks from T1 to T6", 1, 6, "< 0"),
            ("jumps at T7", 6, 7, "> 0"),
            ("shrinks again", 7, 10, "< 0"),
        )
    ]
    return [*_best(), *never, *worse, *ends, *residual]


def linear_claims() -> list[Claim]:
    """What §6.3 and C.3 read off Figure 4."""
    better, not_better = ("ends better than", "> 0"), ("does not improve on", "≤ 0")
    return [
        Claim(
            f"{a} {words} {b}",
            f"late return of {a} − that of {b}",
            expect,
            (a, b),
            lambda *of: between(*(late(variant, "return") for variant in of)),
        )
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
