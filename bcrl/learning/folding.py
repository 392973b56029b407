"""Folding: at a stage's end one approximator takes the place of base + ϱ.

A boosted Q-function has one residual more after each stage. Acting, checkpoints and
agents grow with it, and folding ends that: FQI fits its regressor to Q (`refit`), DQN
distils Q (`distillation`). The sum of tables, or of linear models, is exact.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from bcrl.learning import Floats
from bcrl.q.functions import Q


@dataclass(frozen=True)
class Folded:
    """How folding changed the Q-functions of S seeds at the states of their data."""

    residual: Q  # ϱ as the stage had learned it
    max_change: Floats  # (S,) of |Q after − Q before| over states and actions
    mean_change: Floats  # (S,)
    greedy_changed: Floats  # (S,) share of states whose greedy action is another one
    notes: tuple[str, ...] = field(default=())  # S, empty where all is well

    @classmethod
    def of(
        cls,
        residual: Q,
        before: Sequence[Floats],
        after: Sequence[Floats],
        notes: Sequence[str] = (),
    ) -> "Folded":
        """From the values of S seeds, each (n_s, A), before and after."""
        each = [_changes(*pair) for pair in zip(before, after, strict=True)]
        most, mean, greedy = np.array(each).T
        return cls(residual, most, mean, greedy, tuple(notes) or ("",) * len(each))

    def facts(self, s: int) -> dict[str, float | str]:
        """What the JSON of the seed with index s says."""
        names = ("max_change", "mean_change", "greedy_changed")
        found: dict[str, float | str] = {k: float(getattr(self, k)[s]) for k in names}
        return found | ({"note": self.notes[s]} if self.notes[s] else {})


def _changes(before: Floats, after: Floats) -> tuple[float, float, float]:
    """Greatest and mean |change|, and the share of states with a new greedy action."""
    change, chosen = np.abs(after - before), after.argmax(-1)
    kept = before[np.arange(len(before)), chosen] == before.max(-1)  # ties are none
    return float(change.max()), float(change.mean()), float(1.0 - kept.mean())
