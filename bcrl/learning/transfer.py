"""Transfers: how what the previous stage learned enters the next one.

A transfer edits the next stage's `StageInit`; several may be in force at once, e.g.
`Boost` and `Shape` make SBC-DQN. Learners read only the `StageInit` of the variant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from bcrl.common.serialization import storable
from bcrl.errors import ConfigError, at_least
from bcrl.q.functions import ZERO, Q, Shaped, add, memoized


@storable
@dataclass(frozen=True)
class StageResult:
    """What a stage leaves behind."""

    q: Q  # of the stage's own task: base + ϱ, and the potential if rewards were shaped
    residual: Q  # ϱ, the approximator, to go on from
    data: Any = None  # transitions that the next stage may learn from once more


@dataclass(frozen=True)
class Boost:
    """The previous Q is frozen and a new residual is learned on it (B-; Eq. 5).

    `greedy_on` the `sum` base + ϱ or the `residual`; the target bootstraps with `one`
    maximum of the sum or with `two`, max ϱ + max base; `mask_at_goal`: whether the base
    counts for nothing in an absorbing next state. The defaults are the paper's, the
    released BC-DQN has residual, two and false.
    """

    greedy_on: str = "sum"
    maxima: str = "one"
    mask_at_goal: bool = True

    def __call__(self, start: StageInit, previous: StageResult) -> StageInit:
        return replace(start, base=previous.q, boost=self)


@dataclass(frozen=True)
class Shape:
    """Reward + γ V(s') − V(s) in training, V = max_a of the previous Q (S-; Ng 1999).

    `next_state`: V(s') is taken where the transition is `stored` to lead, or
    `before_reset`; `zero_at_goal`: whether V is zero in an absorbing next state. The
    released shaping has before_reset and false.
    """

    next_state: str = "stored"
    zero_at_goal: bool = True

    def __call__(self, start: StageInit, previous: StageResult) -> StageInit:
        return replace(start, potential=previous.q, shape=self)


@dataclass(frozen=True)
class PolicyReuse:
    """In step t the previous greedy policy acts with probability ν^t (PPR).

    Fernández and Veloso (2006) as read by Brys et al. (2015). Raises ConfigError for ν
    outside [0, 1].
    """

    nu: float = 0.998

    def __post_init__(self) -> None:
        if not 0.0 <= self.nu <= 1.0:
            raise ConfigError("transfer.nu", self.nu, "must lie in [0, 1]")

    def __call__(self, start: StageInit, previous: StageResult) -> StageInit:
        return replace(start, prior=previous.q, behavior=self)


@dataclass(frozen=True)
class ResidualPolicy:
    """The executed action is the one nearest to prior's + own action (RPL).

    Silver et al. (2018). For the first `offset` steps that are not random the own
    action copies the prior's. Raises ConfigError for a negative offset.
    """

    offset: int = 2000

    def __post_init__(self) -> None:
        at_least("transfer.offset", self.offset, 0)

    def __call__(self, start: StageInit, previous: StageResult) -> StageInit:
        return replace(start, prior=previous.q, behavior=self)


@dataclass(frozen=True)
class StageInit:
    """What a stage starts from: it learns ϱ from `initial` on, and Q = base + ϱ."""

    previous: StageResult | None = None
    base: Q = ZERO
    initial: Q = ZERO
    boost: Boost = Boost()  # how the base is used; of no effect where it is zero
    potential: Q = ZERO
    shape: Shape | None = None  # None: rewards as they are
    prior: Q = ZERO
    behavior: PolicyReuse | ResidualPolicy | None = None  # None: the own policy acts

    def whole(self, residual: Q) -> Q:
        """Q = base + `residual`, with what shaping took off the rewards put back."""
        if self.shape is None:
            return add(self.base, residual)
        return Shaped(self.base, residual, self.potential)

    def memoized(self) -> StageInit:
        """The same start, its base and potential asked only once at each state."""
        base = memoized(self.base)
        same = self.potential is self.base
        potential = base if same else memoized(self.potential)
        return replace(self, base=base, potential=potential)


Transfer = Callable[[StageInit, StageResult], StageInit]


def warm_start(start: StageInit, previous: StageResult) -> StageInit:
    """The approximator goes on from where the previous stage left it (C-)."""
    return replace(start, initial=previous.residual)


def begin(transfers: Sequence[Transfer], previous: StageResult | None) -> StageInit:
    """The start of a stage; without a previous stage there is nothing to transfer.

    Raises ConfigError for a transfer that returns something else than a `StageInit`.
    """
    start = StageInit(previous)
    if previous is not None:
        for transfer in transfers:
            start = transfer(start, previous)
            if not isinstance(start, StageInit):
                why = "must return a StageInit (bcrl.learning.transfer), returned "
                why += f"{start!r:.80}"
                raise ConfigError("transfer", transfer, why)
    return start


def _any(states: Any, n_actions: int) -> Any:
    """A Q-function to try transfers on: 0 everywhere, but not `ZERO`."""
    return ZERO(states, n_actions)


def tried(transfers: Sequence[Transfer]) -> StageInit | None:
    """What transfers make of a start; None if they need a Q that was learned."""
    try:
        return begin(transfers, StageResult(_any, _any))
    except ConfigError:
        raise
    except Exception:  # a transfer of the user's that reads, say, a network's weights
        return None


#: name in the YAML of group `transfer` → its class; constructor arguments are its keys
TRANSFERS = {
    "shaping": Shape,
    "policy_reuse": PolicyReuse,
    "residual_policy": ResidualPolicy,
}
