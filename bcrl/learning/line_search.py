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
#: A base must explain at least so many times what it would explain with its values
#: shuffled among the states.
SIGNIFICANT = 2.0
ROUNDS = 100  # of repeated least squares


@storable
@dataclass(frozen=True)
class Searched:
    """The scale α of S seeds' bases, and what each base explains."""

    alpha: Floats  # (S,)
    base_fit: Floats  # (S,) see `fit_of`; nan where nothing was searched
    notes: tuple[str, ...]  # S: why α is 0 or 1 whatever the search found, or empty

    @property
    def reasons(self) -> dict[int, str]:
        """The notes that are not empty, by the seed's index."""
        return {s: why for s, why in enumerate(self.notes) if why}

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


def robust_weights(reward: Floats, gain: Floats) -> Floats:
    """Weights (n,) with which `best_scale` minimises Σ smooth-L1(reward − α · gain).

    That is DQN's loss. A jump, such as a fall back to the start, has a gain far above
    the others; its square would decide about α alone. Found by repeated least squares.
    """
    weights = np.ones(len(reward))
    for _ in range(ROUNDS):
        alpha = best_scale(reward, gain, weights)
        weights = 1.0 / np.maximum(1.0, np.abs(reward - alpha * gain))
    return weights


def fit_of(alpha: float, reward: Floats, gain: Floats, counts: Any = 1) -> float:
    """1 − Σ (reward − α · gain)² / Σ reward²: the share that α · base explains."""
    left, whole = reward - alpha * gain, float((counts * reward * reward).sum())
    return 1.0 - float((counts * left * left).sum()) / whole


def chance_fit(reward: Floats, base: Floats, after: Floats, counts: Any = 1) -> float:
    """`fit_of` the best scale if the values of the base were shuffled among states.

    `base` is base(s, a) and `after` γ (1 − absorbing) max_a' base(s', a'), both (n,). A
    base that does not know which state follows which explains no more than this.
    """
    weight = counts * np.ones(len(reward))
    means = [np.average(x, weights=weight) for x in (reward, base, after)]
    spread = sum(
        np.average((x - mean) ** 2, weights=weight)
        for x, mean in zip((base, after), means[1:], strict=True)
    )
    gain, square = means[1] - means[2], np.average(reward**2, weights=weight)
    return float((means[0] * gain) ** 2 / (square * (gain**2 + spread)))


def search(
    reward: Floats,
    base: Floats,
    next_base: Floats,
    absorbing: Booleans,
    gamma: float,
    counts: Any = 1,
    robust: bool = False,
) -> tuple[float, float, str]:
    """The scale of one seed's base, what the scaled base explains, and a note.

    `next_base` (n, A) is the base at the next states; the other arrays have shape (n,),
    `counts` says how often each transition occurs. `robust`: see `robust_weights`.

    A base that is nearly right keeps its scale, α = 1, since noise in the base shrinks
    the best scale: see ENOUGH. α is 0 with a note if the base explains no more than
    chance: see SIGNIFICANT. α is 1 with a note if the base is zero or not finite on the
    data, if all rewards are zero, or if there are fewer than LEAST transitions.
    """
    after = gamma * np.where(absorbing, 0.0, next_base.max(-1))
    gain, why = base - after, ""
    n = int((counts * np.ones(len(reward))).sum())
    if n < LEAST:
        why = f"a line search needs {LEAST} transitions, here are {n}"
    elif not np.isfinite(gain).all():
        why = "the base is not finite on the data"
    elif not (gain * gain).any():
        why = "the base is zero on the data"
    elif not (reward * reward).any():
        why = "all rewards in the data are zero"
    if why:
        return 1.0, np.nan, f"alpha stays 1: {why}"
    if robust:
        counts = counts * robust_weights(reward, gain)
    alpha = best_scale(reward, gain, counts)
    best, own = (fit_of(each, reward, gain, counts) for each in (alpha, 1.0))
    if best < SIGNIFICANT * chance_fit(reward, base, after, counts):
        return 0.0, 0.0, "alpha is 0: the base explains no more than chance"
    if own >= ENOUGH * best:
        return 1.0, own, ""
    return alpha, best, ""
