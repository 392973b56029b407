"""The environment protocol: pure functions on arrays, no state or randomness inside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, TypeGuard

import numpy as np
from numpy.typing import NDArray

from bcrl.common.serialization import storable
from bcrl.errors import ConfigError

Step = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]


class Env(Protocol):
    """One task, as a frozen dataclass whose fields are its constants.

    Arrays may have any leading axes (seeds, episodes); `d` is `state_dim`, `A` is
    `n_actions`. Noise is drawn by the caller, uniform on [0, 1).
    """

    name: ClassVar[str]
    n_actions: ClassVar[int]
    state_dim: ClassVar[int]
    initial_noise: ClassVar[int]  # uniforms that `initial` takes a state
    step_noise: ClassVar[int]  # uniforms that `step` takes a state
    actions: ClassVar[NDArray[np.float64]]  # (A, k) what each action does, as a vector
    gamma: float  # discount factor
    horizon: int  # steps after which an episode is cut (not absorbing)

    def __hash__(self) -> int:
        """Equal constants have equal hashes."""

    def initial(self, noise: NDArray[np.float64]) -> NDArray[np.float64]:
        """Start states (..., d) from noise (..., initial_noise)."""

    def step(
        self,
        state: NDArray[np.float64],
        action: NDArray[np.integer],
        noise: NDArray[np.float64] | None = None,
    ) -> Step:
        """Next state (..., d), reward (...) and whether it is absorbing (...)."""

    def evaluation_states(self) -> NDArray[np.float64]:
        """States (n, d) from which the greedy policy is evaluated."""


class ContinuousEnv(Env, Protocol):
    """An env that takes any vector as its action; LSPI learns in its LQ tasks."""

    positions: ClassVar[tuple[int, ...]]  # which entry of the state each force moves

    @property
    def linear_quadratic(self) -> tuple[NDArray[np.float64], ...] | None:
        """A, B, Q, R of s' = A s + B a, reward −s'ᵀ Q s' − aᵀ R a; None if not so."""

    def push(
        self,
        state: NDArray[np.float64],
        force: NDArray[np.float64],
        noise: NDArray[np.float64],
    ) -> Step:
        """`step` with actions (..., k)."""


class FiniteEnv(Env, Protocol):
    """A deterministic env that lists its states: its Q is a table, shape (N, A)."""

    finite: bool  # whether the dynamics stay on the listed states

    def states(self) -> NDArray[np.float64]:
        """All states, shape (N, d)."""

    def index(self, state: NDArray[np.float64]) -> NDArray[np.intp]:
        """Row of each state (..., d) in `states()`."""


class Lanes(Protocol):
    """Episodes of one env side by side, one per lane, in arrays of any leading axes."""

    #: Lanes whose simulator failed, counted in C order, and why. Such a lane gives
    #: zeros and is cut at every step; the others don't notice.
    failures: dict[int, str]

    def begin(self, start: NDArray[np.float64]) -> NDArray[np.float64]:
        """The states (…, d) of lanes that start as `initial` says."""

    def step(
        self,
        state: NDArray[np.float64],
        action: NDArray,
        noise: NDArray[np.float64],
        lanes: Any = ...,
    ) -> tuple[NDArray, NDArray, NDArray, NDArray | bool]:
        """A step of the lanes chosen: as `Env.step`, and where an episode is cut."""

    def restart(
        self,
        over: NDArray[np.bool_],
        start: NDArray[np.float64],
        state: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """All states, anew from `start` in the lanes that are over."""

    def close(self) -> None:
        """Free what the lanes hold; they end here."""


class SimulatedEnv(Env, Protocol):
    """An env that keeps its state to itself: only whole episodes can be had of it.

    `initial` gives what a lane is reset by, `state`s are observations, and noise is the
    simulator's own, from the reset on.
    """

    starts: int  # random resets that FQI's greedy policy is evaluated from

    def lanes(self) -> Lanes:
        """Simulators to be stepped side by side."""

    def check_tasks(self, tasks: Sequence[Env]) -> None:
        """Raise ConfigError for tasks that are alike, or don't repeat themselves."""


@storable
@dataclass(frozen=True)
class PureLanes:
    """Lanes of an env whose steps are pure functions: the caller has the states."""

    env: Env
    failures: ClassVar[dict[int, str]] = {}

    def begin(self, start: NDArray[np.float64]) -> NDArray[np.float64]:
        """The start states themselves."""
        return start

    def step(
        self,
        state: NDArray[np.float64],
        action: NDArray,
        noise: NDArray[np.float64],
        lanes: Any = ...,
    ) -> tuple[NDArray, NDArray, NDArray, NDArray | bool]:
        """`step` for actions (…), `push` for forces (…, k); never cut."""
        step = self.env.push if action.ndim == state.ndim else self.env.step
        return *step(state, action, noise), False

    def restart(
        self,
        over: NDArray[np.bool_],
        start: NDArray[np.float64],
        state: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """The start states where it is over."""
        return np.where(over[..., None], start, state)

    def close(self) -> None:
        """Nothing is held."""


def is_simulated(env: Env) -> TypeGuard[SimulatedEnv]:
    """Whether `env` is a SimulatedEnv."""
    return hasattr(env, "lanes")


def lanes_of(env: Env) -> Lanes:
    """Lanes in which episodes of `env` can run side by side."""
    return env.lanes() if is_simulated(env) else PureLanes(env)


def check_episodes(gamma: float, horizon: int) -> None:
    """Raise ConfigError for a discount outside [0, 1) or a horizon below 1."""
    if not 0.0 <= gamma < 1.0:
        raise ConfigError("env.gamma", gamma, "must lie in [0, 1)")
    if horizon < 1:
        raise ConfigError("env.horizon", horizon, "must be at least 1 step")


def is_finite(env: Env) -> TypeGuard[FiniteEnv]:
    """Whether `env` is a FiniteEnv whose Q can be tabulated."""
    return getattr(env, "finite", False) and env.step_noise == 0
