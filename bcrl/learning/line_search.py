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
#: The best scale must explain at least this share of the squared rewards, …
WEAK = 0.25
#: … and its odds (explained / not explained) must be so many times those by chance.
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
    def fixed(cls, alpha: float, n_seeds: int, note: str = "") -> "Searched":
        """The same α for all seeds, not searched."""
        return cls.of([(alpha, np.nan, note)] * n_seeds)

    @classmethod
    def of(cls, seeds: Sequence[tuple[float, float, str]]) -> "Searched":
        """The results of `search`, one per seed."""
        alpha, fit, notes = zip(*seeds, strict=True)
        return cls(np.array(alpha, float), np.array(fit, float), notes)


def best_scale(reward: Floats, gain: Floats, counts: Any = 1) -> float:
    """The α ≥ 0 that minimises Σ counts · (reward − α · gain)², all of shape (n,).

    `gain` is f(s, a, s') = base(s, a) − γ (1 − absorbing) max_a' base(s', a'). As the
    maximum is positively homogeneous, reward − α · gain is the Bellman residual of
    α · base: this is the step size of gradient boosting (Friedman 2001) in closed form.
    """
    square = float((counts * gain * gain).sum())
    return max(0.0, float((counts * reward * gain).sum()) / square)


def robust_weights(reward: Floats, gain: Floats, counts: Any = 1) -> Floats:
    """`counts` times weights (n,) with which `best_scale` minimises DQN's loss.

    The loss is Σ counts · smooth-L1(reward − α · gain). A jump, such as a fall back to
    the start, has a gain far above the others; its square alone would decide about α.
    """
    weights = counts * np.ones(len(reward))
    for _ in range(ROUNDS):  # repeated least squares
        alpha = best_scale(reward, gain, weights)
        weights = counts / np.maximum(1.0, np.abs(reward - alpha * gain))
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


@np.errstate(over="ignore", invalid="ignore", under="ignore")
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
    the best scale: see ENOUGH. α is 0 with a note if the base explains little, or no
    more than chance: see WEAK and SIGNIFICANT. α is 1 with a note if rewards or base
    are zero or not finite on the data, or if there are fewer than LEAST transitions.
    """
    after = gamma * np.where(absorbing, 0.0, next_base.max(-1))
    gain = base - after
    n, unit, own = int((counts * np.ones(len(reward))).sum()), 0.0, 0.0
    if n:  # the squares of rewards and gains in these units are neither 0 nor infinite
        unit, own = float(np.abs(reward).max()), float(np.abs(gain).max())
    why = ""
    if n < LEAST:
        why = f"a line search needs {LEAST} transitions, here are {n}"
    elif not np.isfinite([unit, own]).all():
        why = "the rewards or the base are not finite on the data"
    elif not own:
        why = "the base is zero on the data"
    elif not unit:
        why = "all rewards in the data are zero"
    if why:
        return 1.0, np.nan, f"alpha stays 1: {why}"
    gain = gain / own
    if robust:
        counts = robust_weights(reward, gain, counts)
    reward = reward / unit
    best = best_scale(reward, gain, counts)
    fit = fit_of(best, reward, gain, counts)
    chance = chance_fit(reward, base / own, after / own, counts)
    if fit < WEAK:
        return 0.0, 0.0, f"alpha is 0: the base explains only {fit:.3f} of the rewards"
    if fit * (1.0 - chance) < SIGNIFICANT * chance * (1.0 - fit):
        return 0.0, 0.0, "alpha is 0: the base explains no more than chance"
    if (unchanged := fit_of(own / unit, reward, gain, counts)) >= ENOUGH * fit:
        return 1.0, unchanged, ""
    return best * (unit / own), fit, ""
