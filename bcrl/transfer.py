"""Transfers: how the previous stage's Q enters the next stage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from bcrl.q import ZERO, Q


@dataclass(frozen=True)
class Start:
    """What a stage starts from: it learns ϱ from `initial` on, and Q = base + ϱ."""

    base: Q
    initial: Q


Transfer = Callable[[Q], Start]


def warm_start(previous: Q) -> Start:
    """The approximator goes on from where the previous stage left it (C-)."""
    return Start(base=ZERO, initial=previous)


def boost(previous: Q) -> Start:
    """The previous Q is frozen and a new residual is learned on it (B-, BC-; Eq. 5)."""
    return Start(base=previous, initial=ZERO)
