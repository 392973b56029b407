"""The environment protocol: pure functions on arrays, no state or randomness inside."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from numbers import Integral, Real
from typing import Any, ClassVar, NamedTuple, Protocol, TypeGuard

import numpy as np
from numpy.typing import NDArray

from bcrl.common.serialization import storable
from bcrl.errors import ConfigError

Floats = NDArray[np.float64]
Ints = NDArray[np.integer]
Bools = NDArray[np.bool_]
Step = tuple[Floats, Floats, Bools]  # next state (..., d), reward, absorbing (...)

#: Rules by which an episode counts as solved: docs/reference/gymnasium.md.
RULES = ("absorbed", "survived", "unpunished", "rewarded", "threshold", "info")


class Success(NamedTuple):
    """One of RULES; `threshold` is the return that the rule `threshold` needs."""

    rule: str = "unpunished"
    threshold: float = 0.0


def default_success(reports: bool, low: float, high: float, goal: float | None) -> str:
    """The rule of `env.success` that suits the rewards of random play.

    `reports`: info has a success key. `low`, `high`: least and largest reward of the
    steps that did not terminate. `goal`: the registered `reward_threshold`.
    """
    if reports:
        return "info"
    if low < high and goal is not None:
        return "rewarded" if high < 0 < goal else "threshold"
    return "absorbed" if high < 0 else "survived" if low > 0 else "rewarded"


class Env(Protocol):
    """One task, as a frozen dataclass whose fields are its constants.

    Arrays may have any leading axes (seeds, episodes); d is `state_dim`, A `n_actions`.
    The caller draws the noise, uniform on [0, 1).
    """

    name: ClassVar[str]
    n_actions: ClassVar[int]
    state_dim: ClassVar[int]
    initial_noise: ClassVar[int]  # uniforms that `initial` takes per state
    step_noise: ClassVar[int]  # uniforms that `step` takes per state
    actions: ClassVar[Floats]  # (A, k) the vector that each action applies
    gamma: float  # discount factor
    horizon: int  # steps after which an episode is cut (not absorbing)

    def __hash__(self) -> int: ...

    def initial(self, noise: Floats) -> Floats:
        """Start states (..., d) from noise (..., initial_noise)."""

    def step(self, state: Floats, action: Ints, noise: Floats | None = None) -> Step:
        """Next state (..., d), reward (...) and whether it is absorbing (...)."""

    def evaluation_states(self) -> Floats:
        """States (n, d) from which the greedy policy is evaluated."""


class ContinuousEnv(Env, Protocol):
    """An environment that takes any vector as its action; LSPI learns in LQ tasks."""

    positions: ClassVar[tuple[int, ...]]  # which entry of the state each force moves

    @property
    def linear_quadratic(self) -> tuple[Floats, ...] | None:
        """A, B, Q, R of s' = A s + B a, reward −s'ᵀ Q s' − aᵀ R a; None if not so."""

    def push(self, state: Floats, force: Floats, noise: Floats) -> Step:
        """`step` with actions (..., k)."""


class FiniteEnv(Env, Protocol):
    """A deterministic environment that lists its states: its Q is a table (N, A)."""

    finite: bool  # whether the dynamics stay on the listed states

    def states(self) -> Floats:
        """All states, shape (N, d)."""

    def index(self, state: Floats) -> NDArray[np.intp]:
        """Row of each state (..., d) in `states()`."""


@storable
@dataclass(eq=False)
class Lanes:
    """Episodes of a pure environment side by side, one per lane; any leading axes."""

    costly: ClassVar[bool] = False  # whether only few lanes should exist at a time

    env: Any
    #: Why a lane's simulator failed, by the lane's number in C order. Such a lane gives
    #: zeros and is cut at every step.
    failures: dict[int, str] = field(default_factory=dict)

    def begin(self, start: Floats) -> Floats:
        """Observations (..., d) of lanes that start as `initial` says."""
        return start

    def step(self, state: Any, action: NDArray, noise: Any, lanes: Any = ...) -> tuple:
        """What `step` (`push` for forces) gives in chosen lanes, and which are cut."""
        step = self.env.push if action.ndim == state.ndim else self.env.step
        return *step(state, action, noise), False

    def restart(self, over: Bools, start: Floats, state: Floats) -> Floats:
        """All states; lanes that are over begin again from `start`."""
        return np.where(over[..., None], start, state)

    def close(self) -> None:
        """Free the lanes' resources; the lanes end here."""


class SimulatedEnv(Env, Protocol):
    """Simulators with hidden states: `initial` gives the numbers that reset lanes."""

    starts: int  # random resets from which FQI's greedy policy is evaluated

    def lanes(self) -> Lanes:
        """Episodes side by side."""

    def check_tasks(self, tasks: Sequence[Env]) -> None:
        """Raise ConfigError for tasks that are alike or not reproducible."""


def is_simulated(env: Env) -> TypeGuard[SimulatedEnv]:
    """Whether `env` is a SimulatedEnv."""
    return hasattr(env, "lanes")


def is_finite(env: Env) -> TypeGuard[FiniteEnv]:
    """Whether `env` is a FiniteEnv whose Q can be tabulated."""
    return getattr(env, "finite", False) and env.step_noise == 0


def lanes_of(env: Env) -> Lanes:
    """Lanes in which episodes of `env` can run side by side."""
    return env.lanes() if is_simulated(env) else Lanes(env)


def check_episodes(gamma: float, horizon: int) -> None:
    """Raise ConfigError for a discount outside [0, 1) or a horizon below 1."""
    if not (isinstance(gamma, Real) and 0 <= gamma < 1):
        raise ConfigError("env.gamma", gamma, "must be a number in [0, 1)")
    if not isinstance(horizon, Integral) or horizon < 1:
        raise ConfigError("env.horizon", horizon, "must be an integer ≥ 1 (steps)")
