"""The paper's claims about car on the hill, the maze and the linear system."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bcrl.report.claims.judge import Claim, NotMeasurable, Quantity
from bcrl.report.late import late
from bcrl.report.variants import Variant

OPTIMAL = 1e-3  # a return this near V*(s0) is optimal: a detour costs 100 times more
NEAR = 0.01  # a mean return within this share of |V*(s0)| is nearly optimal
BC, C, B = "BC-FQI", "C-FQI", "B-FQI"


def _at(variant: Variant, metric: str, stage: int, row: int = -1) -> NDArray:
    """A metric at a row of a stage, the last one by default, (S,)."""
    rows = variant.rows(stage)
    if not len(rows):
        raise NotMeasurable(f"{variant.name} has no stage {stage}")
    return variant.metrics[metric][:, rows[row]]


def _before_target(variant: Variant, metric: str) -> NDArray[np.float64]:
    """Mean of a metric over the ends of the stages before the target, (S,).

    Those of the curriculum's second half: T5 to T9 of ten tasks.
    """
    n = int(variant.stage[-1])
    ends = [_at(variant, metric, stage) for stage in range(max(1, n // 2), n)]
    if not ends:
        raise NotMeasurable(f"{variant.name} has one stage only")
    return np.mean(ends, axis=0)


def _optimum(variant: Variant) -> float:
    if variant.optimum is None:
        raise NotMeasurable("the runs do not record one optimum")
    return variant.optimum


def _residual(statement: str, start: int, end: int, expect: str) -> Claim:
    """A claim about the change of BC-FQI's |residual at s0| between two stages."""

    def change(variant: Variant) -> NDArray[np.float64]:
        before, after = (abs(_at(variant, "residual_start", n)) for n in (start, end))
        return after - before

    words = f"|residual at s0|, end of T{end} − end of T{start}"
    return Claim(
        f"BC-FQI's residual at s0 {statement}", Quantity(words, change), expect, (BC,)
    )


ERROR = Quantity("q_error, last iteration", lambda v: v.last("q_error"))
RETURN = Quantity("return, last iteration", lambda v: v.last("return"))
DEVIATION = Quantity(f"standard deviation of the {RETURN.words}", RETURN.of, np.std)
SOLVED = Quantity(
    "share of seeds that solve the target, last iteration",
    lambda v: v.last("solved") > 0,
)
SWITCH = Quantity(
    "change of q_error from T1's last to T2's first iteration",
    lambda v: _at(v, "q_error", 2, 0) - _at(v, "q_error", 1),
)
ON_TARGET = Quantity(
    "change of q_error from T3's first to its last iteration",
    lambda v: _at(v, "q_error", 3) - _at(v, "q_error", 3, 0),
)
AFTER_T2 = Quantity("q_error, end of stage 2", lambda v: _at(v, "q_error", 2))
BEFORE = "mean over stage ends before the target (T5 to T9)"
ERROR_BEFORE = Quantity(f"q_error, {BEFORE}", lambda v: _before_target(v, "q_error"))
SOLVED_BEFORE = Quantity(f"solved, {BEFORE}", lambda v: _before_target(v, "solved"))
AT_OPTIMUM = Quantity(
    f"share of seeds whose return is within {OPTIMAL:g} of V*(s0)",
    lambda v: v.last("return") >= _optimum(v) - OPTIMAL,
)
NEAR_OPTIMUM = Quantity(
    f"(return − V*(s0)) / |V*(s0)| + {NEAR:g}, last iteration",
    lambda v: (v.last("return") - _optimum(v)) / abs(_optimum(v)) + NEAR,
)
LATE_RETURN = Quantity("late return", lambda v: late(v, "return"))

#: BC-FQI ends with the smallest error and the largest return of all methods.
BEST = tuple(
    Claim(f"BC-FQI ends with a {words} than {other}", quantity, expect, (BC, other))
    for words, quantity, expect in (
        ("smaller error", ERROR, "< 0"),
        ("larger return", RETURN, "> 0"),
    )
    for other in ("FQI", C, B)
)

#: What §6.1 reads off Figure 1.
CAR_CLAIMS = (
    *BEST,
    Claim("C-FQI's error jumps from T1 to T2", SWITCH, "> 0", (C,)),
    Claim("BC-FQI's error does not rise from T1 to T2", SWITCH, "≤ 0", (BC,)),
    Claim("BC-FQI's error changes less than C-FQI's there", SWITCH, "< 0", (BC, C)),
    Claim("BC-FQI's error falls on the target task", ON_TARGET, "< 0", (BC,)),
    Claim("C-FQI's error rises on the target task", ON_TARGET, "> 0", (C,)),
    Claim("when T2 ends BC-FQI's error is below B-FQI's", AFTER_T2, "< 0", (BC, B)),
)

#: What §6.2 and C.2 read off Figures 2, 3 and 5.
MAZE_CLAIMS = (
    *BEST,
    Claim("FQI never solves the target", SOLVED, "= 0", ("FQI",)),
    Claim("B-FQI never solves the target", SOLVED, "= 0", (B,)),
    Claim("C-FQI's error is larger before the target", ERROR_BEFORE, "> 0", (C, BC)),
    Claim("C-FQI solves fewer tasks before the target", SOLVED_BEFORE, "< 0", (C, BC)),
    Claim("fewer seeds of C-FQI solve the target", SOLVED, "< 0", (C, BC)),
    Claim("C-FQI's return varies more between seeds", DEVIATION, "> 0", (C, BC)),
    Claim("most seeds of BC-FQI end at the optimum", AT_OPTIMUM, "> ½", (BC,)),
    Claim("BC-FQI's mean return is nearly optimal", NEAR_OPTIMUM, "> 0", (BC,)),
    _residual("shrinks from T1 to T6", 1, 6, "< 0"),
    _residual("jumps at T7", 6, 7, "> 0"),
    _residual("shrinks again", 7, 10, "< 0"),
)

#: What §6.3 and C.3 read off Figure 4.
LINEAR_CLAIMS = tuple(
    Claim(
        f"{a} {words} {b}",
        LATE_RETURN,
        "> 0" if words == "ends better than" else "≤ 0",
        (a, b),
    )
    for a, words, b in (
        ("BC-DQN", "ends better than", "DQN"),
        ("BC-DQN", "ends better than", "C-DQN"),
        ("C-DQN", "does not improve on", "DQN"),
        ("RPL", "does not improve on", "DQN"),
        ("PPR", "does not improve on", "DQN"),
        ("SC-DQN", "ends better than", "DQN"),
        ("SBC-DQN", "ends better than", "SC-DQN"),
        ("SBC-DQN", "ends better than", "DQN"),
    )
)
