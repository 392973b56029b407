"""The paper's claims about car on the hill (§6.1) and the maze (§6.2, C.2), judged."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bcrl.report.statistics import row_deviation
from bcrl.report.variants import METHODS, Variant
from bcrl.report.verdicts import (
    Claim,
    Measured,
    NotMeasurable,
    between,
    first_of,
    last_of,
    share,
    share_difference,
    within,
)

OPTIMAL = 1e-3  # a return this near V*(s0) is optimal: a detour costs 100 times more
NEAR = 0.01  # a mean return within this share of |V*(s0)| is nearly optimal
BC, C, B = "BC-FQI", "C-FQI", "B-FQI"
OTHERS = tuple(name for name in METHODS if name != BC)


def final(variant: Variant, metric: str) -> NDArray[np.float64]:
    """A metric after the last iteration, (S,)."""
    return variant.metrics[metric][:, -1]


def best_claims() -> list[Claim]:
    """BC-FQI ends with the smallest error and the largest return of all methods."""
    return [
        Claim(
            f"BC-FQI ends with {words} than {other}",
            f"{metric} of BC-FQI − that of {other}, last iteration",
            expect,
            (BC, other),
            lambda a, b, metric=metric: between(final(a, metric), final(b, metric)),
        )
        for metric, words, expect in (
            ("q_error", "a smaller error", "< 0"),
            ("return", "a larger return", "> 0"),
        )
        for other in OTHERS
    ]


def _at_switch(variant: Variant) -> NDArray[np.float64]:
    """Change of the error from T1's last iteration to T2's first, (S,)."""
    error = variant.metrics["q_error"]
    return error[:, first_of(variant, 2)] - error[:, last_of(variant, 1)]


def _over_stage(variant: Variant, stage: int) -> NDArray[np.float64]:
    """Change of the error from a stage's first iteration to its last, (S,)."""
    error = variant.metrics["q_error"]
    return error[:, last_of(variant, stage)] - error[:, first_of(variant, stage)]


def _error_after(variant: Variant, stage: int) -> NDArray[np.float64]:
    return variant.metrics["q_error"][:, last_of(variant, stage)]


def car_claims() -> list[Claim]:
    """What §6.1 reads off Figure 1."""
    switch = "change of q_error from T1's last to T2's first iteration"
    target = "change of q_error from T3's first to its last iteration"
    return [
        *best_claims(),
        Claim(
            "C-FQI's error jumps from T1 to T2",
            f"{switch}, C-FQI",
            "> 0",
            (C,),
            lambda c: within(_at_switch(c)),
        ),
        Claim(
            "BC-FQI's error does not rise from T1 to T2",
            f"{switch}, BC-FQI",
            "≤ 0",
            (BC,),
            lambda bc: within(_at_switch(bc)),
        ),
        Claim(
            "BC-FQI's change from T1 to T2 is smaller than C-FQI's",
            f"{switch}, BC-FQI − C-FQI",
            "< 0",
            (BC, C),
            lambda bc, c: between(_at_switch(bc), _at_switch(c)),
        ),
        Claim(
            "BC-FQI's error falls on the target task",
            f"{target}, BC-FQI",
            "< 0",
            (BC,),
            lambda bc: within(_over_stage(bc, 3)),
        ),
        Claim(
            "C-FQI's error rises on the target task",
            f"{target}, C-FQI",
            "> 0",
            (C,),
            lambda c: within(_over_stage(c, 3)),
        ),
        Claim(
            "when T2 ends BC-FQI's error is smaller than B-FQI's",
            "q_error of BC-FQI − that of B-FQI, end of stage 2",
            "< 0",
            (BC, B),
            lambda bc, b: between(_error_after(bc, 2), _error_after(b, 2)),
        ),
    ]


def _before_target(variant: Variant, metric: str) -> NDArray[np.float64]:
    """Mean of a metric over the ends of the stages before the target, (S,).

    Those of the curriculum's second half: T5 to T9 of ten tasks.
    """
    n = int(variant.stage[-1])
    rows = [last_of(variant, stage) for stage in range(max(1, n // 2), n)]
    if not rows:
        raise NotMeasurable(f"{variant.name} has one stage only")
    return variant.metrics[metric][:, rows].mean(axis=1)


def _solved(variant: Variant) -> NDArray[np.bool_]:
    return final(variant, "solved") > 0


def _never(variant: Variant) -> Measured:
    ever = int((variant.metrics["solved"] > 0).any(axis=1).sum())
    return share(_solved(variant), f"; {ever} at any iteration")


def _optimum(variant: Variant) -> float:
    if variant.optimum is None:
        raise NotMeasurable("the runs do not record one optimum")
    return variant.optimum


def _at_optimum(variant: Variant) -> Measured:
    return share(final(variant, "return") >= _optimum(variant) - OPTIMAL)


def _above_near(variant: Variant) -> Measured:
    optimum = _optimum(variant)
    returns = final(variant, "return")
    gap = within((returns - optimum) / abs(optimum) + NEAR)
    detail = f" (mean return {returns.mean():.3f}, optimum {optimum:.3f})"
    return Measured(gap.value, gap.interval, detail.replace("-", "−"))


def _residual_change(variant: Variant, start: int, end: int) -> Measured:
    """Change of |residual at s0| between two stages' ends."""
    size = np.abs(variant.metrics["residual_start"])
    before, after = (size[:, last_of(variant, stage)] for stage in (start, end))
    detail = f" ({before.mean():.3g} → {after.mean():.3g})"
    return within(after - before, detail)


def maze_claims() -> list[Claim]:
    """What §6.2 and C.2 read off Figures 2, 3 and 5."""
    half = "mean over stage ends before the target (T5 to T9)"
    residual = "change of |residual at s0|, end of"
    return [
        *best_claims(),
        *(
            Claim(
                f"{name} never solves the target",
                "share of seeds solving it after the last iteration",
                "= 0",
                (name,),
                _never,
            )
            for name in ("FQI", B)
        ),
        Claim(
            "C-FQI deteriorates before the target: its error",
            f"exact q_error of C-FQI − that of BC-FQI, {half}",
            "> 0",
            (C, BC),
            lambda c, bc: between(
                _before_target(c, "q_error"), _before_target(bc, "q_error")
            ),
        ),
        Claim(
            "C-FQI deteriorates before the target: tasks solved",
            f"share solved by C-FQI − that by BC-FQI, {half}",
            "< 0",
            (C, BC),
            lambda c, bc: between(
                _before_target(c, "solved"), _before_target(bc, "solved")
            ),
        ),
        Claim(
            "C-FQI ends unreliable: fewer seeds solve the target",
            "share of seeds, C-FQI − BC-FQI, last iteration",
            "< 0",
            (C, BC),
            lambda c, bc: share_difference(_solved(c), _solved(bc)),
        ),
        Claim(
            "C-FQI ends unreliable: its return varies more between seeds",
            "standard deviation of the return, C-FQI − BC-FQI, last iteration",
            "> 0",
            (C, BC),
            lambda c, bc: between(
                final(c, "return"), final(bc, "return"), row_deviation
            ),
        ),
        Claim(
            "BC-FQI learns an optimal policy: most seeds are at the optimum",
            f"share of seeds whose return is within {OPTIMAL:g} of V*(s0)",
            "> ½",
            (BC,),
            _at_optimum,
        ),
        Claim(
            f"BC-FQI's mean return is within {NEAR:.0%} of the optimum",
            f"(return − V*(s0)) / |V*(s0)| + {NEAR:g}, last iteration",
            "> 0",
            (BC,),
            _above_near,
        ),
        *(
            Claim(
                f"BC-FQI's residual at s0 {words}",
                f"{residual} T{end} − end of T{start}",
                expect,
                (BC,),
                lambda bc, start=start, end=end: _residual_change(bc, start, end),
            )
            for words, start, end, expect in (
                ("shrinks from T1 to T6", 1, 6, "< 0"),
                ("jumps at T7", 6, 7, "> 0"),
                ("shrinks again", 7, 10, "< 0"),
            )
        ),
    ]
