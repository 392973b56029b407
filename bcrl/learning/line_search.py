"""How much of the base to keep: the line search of boosting, Q = α · base + ϱ."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bcrl.common.serialization import storable
from bcrl.learning import Booleans, Floats

LEAST = 100  # transitions that a search needs
#: The base keeps its own scale if that explains at least this share of what the best
#: scale explains: if the best α is between 0.59 and 3.41.
ENOUGH = 0.5


@storable
@dataclass(frozen=True)
class Searched:
    """The scale α of S seeds' bases, and what each base explains."""

    alpha: Floats  # (S,)
    base_fit: Floats  # (S,) see `fit_of`; nan where nothing was searched
    notes: tuple[str, ...]  # S: why α is 1 without a search, or empty

    @classmethod
    def fixed(cls, alpha: float, n_seeds: int) -> "Searched":
        """The same α for all seeds, not searched."""
        return cls.of([(alpha, np.nan, "")] * n_seeds)

    @classmethod
    def of(cls, seeds: Sequence[tuple[float, float, str]]) -> "Searched":
        """The results of `search`, one per seed."""
        alpha, fit, notes = zip(*seeds, strict=True)
        return cls(np.array(alpha), np.array(fit), notes)


def best_scale(reward: Floats, gain: Floats, counts: Any = 1) -> float:
    """The α ≥ 0 that minimises Σ counts · (reward − α · gain)², all of shape (n,).

    `gain` is f(s, a, s') = base(s, a) − γ (1 − absorbing) max_a' base(s', a'). As the
    maximum is positively homogeneous, reward − α · gain is the Bellman residual of
    α · base: this is the step size of gradient boosting (Friedman 2001) in closed form.
    """
    square = float((counts * gain * gain).sum())
    return max(0.0, float((counts * reward * gain).sum()) / square)


def fit_of(alpha: float, reward: Floats, gain: Floats, counts: Any = 1) -> float:
    """1 − Σ (reward − α · gain)² / Σ reward²: the share that α · base explains."""
    left, whole = reward - alpha * gain, float((counts * reward * reward).sum())
    return 1.0 - float((counts * left * left).sum()) / whole if whole else np.nan


def search(
    reward: Floats,
    base: Floats,
    next_base: Floats,
    absorbing: Booleans,
    gamma: float,
    counts: Any = 1,
) -> tuple[float, float, str]:
    """The scale of one seed's base, what the scaled base explains, and a note.

    `next_base` (n, A) is the base at the next states; the other arrays have shape (n,),
    `counts` says how often each transition occurs. A base that is nearly right keeps
    its scale, α = 1, since noise in the base shrinks the best scale: see ENOUGH. α is 1
    with a note if the base is zero or not finite on the data, or if there are fewer
    than LEAST transitions.
    """
    gain = base - gamma * np.where(absorbing, 0.0, next_base.max(-1))
    n, why = int((counts * np.ones(len(reward))).sum()), ""
    if n < LEAST:
        why = f"a line search needs {LEAST} transitions, here are {n}"
    elif not np.isfinite(gain).all():
        why = "the base is not finite on the data"
    elif not gain.any():
        why = "the base is zero on the data"
    if why:
        return 1.0, np.nan, f"alpha stays 1: {why}"
    alpha = best_scale(reward, gain, counts)
    best, own = (fit_of(each, reward, gain, counts) for each in (alpha, 1.0))
    if own >= ENOUGH * best > 0.0:
        return 1.0, own, ""
    return alpha, best, ""
