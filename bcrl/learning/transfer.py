"""Transfers: how the result of one stage enters the next.

A transfer edits the next stage's `StageInit`, which is all that learners read. Several
can be combined: `Boost` and `Shape` make SBC-DQN.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from numbers import Integral, Real
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from bcrl.common.seed_axis import seeds_on
from bcrl.common.serialization import storable
from bcrl.errors import ConfigError, at_least
from bcrl.learning import Floats
from bcrl.q.functions import ZERO, Q, Shaped, Sum, add, memoized, scaled

SEARCH = "search"  # a value of `Boost.alpha`
NEVER, ALWAYS = "never", "always"  # values of `Boost.fold`


@storable
@dataclass(frozen=True)
class Acting:
    """What the greedy policy of a stage reads instead of its Q (DQN)."""

    own: Q  # the own action is greedy on it: base + ϱ, or ϱ alone
    #: (S,) RPL: whether the own action still copies the prior's.
    copying: NDArray[np.bool_] = field(metadata=seeds_on(0))
    prior: Q = ZERO  # RPL: the executed action is nearest to the prior's + the own one


@storable
@dataclass(frozen=True)
class StageResult:
    """What a stage has learned."""

    q: Q  # of the stage's task: base + ϱ, plus the potential if rewards were shaped
    residual: Q  # ϱ, the approximator; `warm_start` trains it further
    data: Any = None  # transitions that the next stage may learn from again
    acting: Acting | None = None  # None: the policy is greedy on `q`


def _is(kind: type, value: Any) -> bool:
    """Whether a value is a number of a kind; true and false are none."""
    return isinstance(value, kind) and not isinstance(value, bool)


@dataclass(frozen=True)
class Boost:
    """The previous Q is frozen as the base of a new residual (B-; paper, Eq. 5).

    `greedy_on`: the policy is greedy on the `sum` base + ϱ or on the `residual` ϱ.
    `maxima`: the target bootstraps with `one` maximum, that of the sum, or with `two`,
    max ϱ + max base. `mask_at_goal`: the base does not count in absorbing next states.
    The defaults are the paper's; the released BC-DQN has residual, two and false.
    `alpha`: a factor ≥ 0 of the base, or `search` for one that suits each seed's data
    (`line_search`; not in the paper).
    `fold`: whether Q becomes one approximator at the end of a stage (`folding`; not in
    the paper): `never`, `always`, or after every so many stages, counted from the
    second. `fold_loss`: the error that a network may have then, as a share of the
    spreads of V and of the advantages. Raises ConfigError for other values.
    """

    greedy_on: Literal["sum", "residual"] = "sum"
    maxima: Literal["one", "two"] = "one"
    mask_at_goal: bool = True
    alpha: float | Literal["search"] = 1.0
    fold: int | Literal["never", "always"] = "never"
    fold_loss: float = 0.03

    def __post_init__(self) -> None:
        alpha: Any = self.alpha
        fold: Any = self.fold
        loss = self.fold_loss
        if alpha != SEARCH and not (_is(Real, alpha) and 0.0 <= alpha < math.inf):
            why = "must be a number of at least 0, or search"
            raise ConfigError("boosting.alpha", alpha, why)
        if fold not in (NEVER, ALWAYS) and not (_is(Integral, fold) and fold >= 1):
            why = "must be never, always, or a whole number of stages of at least 1"
            raise ConfigError("boosting.fold", fold, why)
        if not (_is(Real, loss) and 0.0 < loss < math.inf):
            raise ConfigError("boosting.fold_loss", loss, "must be a number above 0")
        if fold != NEVER and self.greedy_on != "sum":
            why = "folds the sum, but the agent acts on the residual alone: fold=never"
            raise ConfigError("boosting.fold", fold, why)

    def folds(self, stage: int) -> bool:
        """Whether Q is folded at the end of a stage, counted from 1."""
        every: Any = 1 if self.fold == ALWAYS else self.fold
        return every != NEVER and stage > 1 and (stage - 1) % every == 0

    def __call__(self, start: "StageInit", previous: StageResult) -> "StageInit":
        return replace(start, base=previous.q, boost=self)


@dataclass(frozen=True)
class Shape:
    """Training rewards are r + γ V(s') − V(s), V = max_a previous Q (S-; Ng 1999).

    `next_state`: s' is the `stored` next state, or the one `before_reset`.
    `zero_at_goal`: V is zero in absorbing next states. The released shaping has
    before_reset and false.
    """

    next_state: Literal["stored", "before_reset"] = "stored"
    zero_at_goal: bool = True

    def __call__(self, start: "StageInit", previous: StageResult) -> "StageInit":
        return replace(start, potential=previous.q, shape=self)


@dataclass(frozen=True)
class PolicyReuse:
    """In step t the previous greedy policy acts with probability ν^t, 0 ≤ ν ≤ 1 (PPR).

    Source: Fernández and Veloso (2006), in the version of Brys et al. (2015).
    """

    nu: float = 0.998

    def __post_init__(self) -> None:
        if not 0.0 <= self.nu <= 1.0:
            raise ConfigError("transfer.nu", self.nu, "must lie in [0, 1]")

    def __call__(self, start: "StageInit", previous: StageResult) -> "StageInit":
        return replace(start, prior=previous.q, behavior=self)


@dataclass(frozen=True)
class ResidualPolicy:
    """The executed action is the one nearest to the prior's + the own action (RPL).

    In the first `offset` ≥ 0 greedy decisions the own action copies the prior's.
    Source: Silver et al. (2018).
    """

    offset: int = 2000

    def __post_init__(self) -> None:
        at_least("transfer.offset", self.offset, 0)

    def __call__(self, start: "StageInit", previous: StageResult) -> "StageInit":
        return replace(start, prior=previous.q, behavior=self)


@dataclass(frozen=True)
class StageInit:
    """What a stage starts from: it trains ϱ, initially `initial`, and Q = base + ϱ."""

    previous: StageResult | None = None
    base: Q = ZERO
    initial: Q = ZERO
    boost: Boost = Boost()  # how the base is used; no effect with a zero base
    potential: Q = ZERO
    shape: Shape | None = None  # None: rewards are not shaped
    prior: Q = ZERO
    behavior: PolicyReuse | ResidualPolicy | None = None  # None: the own policy acts

    def total(self, residual: Q) -> Q:
        """Q = base + `residual`, plus the potential if rewards are shaped."""
        if self.shape is None:
            return add(self.base, residual)
        return Shaped(self.base, residual, self.potential)

    @property
    def alpha(self) -> float | Literal["search"]:
        """The factor that the learner applies to the base; 1 without a base."""
        return 1.0 if self.base is ZERO else self.boost.alpha

    def rescaled(self, alpha: Floats) -> "StageInit":
        """The same with each seed's base times its entry of `alpha` (S,).

        The potential has the base's scale if both are the same Q-function (SBC-).
        """
        base = scaled(self.base, alpha)
        same = self.potential is self.base
        return replace(self, base=base, potential=base if same else self.potential)

    def memoized(self) -> "StageInit":
        """The same with a base and a potential that cache their values."""
        base, same = memoized(self.base), self.potential is self.base
        potential = base if same else memoized(self.potential)
        return replace(self, base=base, potential=potential)


Transfer = Callable[[StageInit, StageResult], StageInit]


def warm_start(start: StageInit, previous: StageResult) -> StageInit:
    """The previous stage's approximator is trained further (C-)."""
    return replace(start, initial=previous.residual)


def begin(transfers: Sequence[Transfer], previous: StageResult | None) -> StageInit:
    """The start of a stage, by all transfers in order; a first stage has none."""
    start = StageInit(previous)
    if previous is None:
        return start
    for transfer in transfers:
        start = transfer(start, previous)
        if not isinstance(start, StageInit):
            why = f"must return a bcrl.learning.transfer.StageInit, not {start!r:.80}"
            raise ConfigError("transfer", transfer, why)
    return start


def tried(transfers: Sequence[Transfer]) -> StageInit | None:
    """The start that `transfers` make of zero Q-functions; None if they need others."""
    zero = Sum((ZERO,))  # not `ZERO`, which stands for no transfer
    try:
        return begin(transfers, StageResult(zero, zero))
    except ConfigError:
        raise
    except Exception:  # a user's transfer that reads, for example, network weights
        return None


#: name in the YAML of group `transfer` → its class; constructor arguments are its keys
TRANSFERS = {
    "shaping": Shape,
    "policy_reuse": PolicyReuse,
    "residual_policy": ResidualPolicy,
}
