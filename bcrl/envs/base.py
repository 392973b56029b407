"""The environment protocol: pure functions on arrays, no state or randomness inside."""

from __future__ import annotations

from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

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


def check_episodes(gamma: float, horizon: int) -> None:
    """Raise ConfigError for a discount outside [0, 1) or a horizon below 1."""
    if not 0.0 <= gamma < 1.0:
        raise ConfigError("env.gamma", gamma, "must lie in [0, 1)")
    if horizon < 1:
        raise ConfigError("env.horizon", horizon, "must be at least 1 step")


def is_finite(env: Env) -> bool:
    """Whether `env` is a FiniteEnv whose Q can be tabulated."""
    return getattr(env, "finite", False) and env.step_noise == 0
