"""Least-squares policy iteration with quadratic features (Lagoudakis and Parr 2003)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bcrl.common.arrays import ndtri
from bcrl.common.seeding import stream
from bcrl.envs.base import ContinuousEnv, Env
from bcrl.errors import ConfigError
from bcrl.learning.rollout import Policy, play, start_states
from bcrl.learning.stage import SeedBatch, Stage, StepSnapshot
from bcrl.learning.transfer import StageInit, StageResult
from bcrl.q.functions import ZERO, Q
from bcrl.q.quadratic import Quadratic, features


@dataclass(frozen=True)
class LSPI:
    """Policy iteration on a = K s + noise, K = 0 at first (paper, C.3).

    Each iteration collects its share of the `steps` in whole episodes with the current
    gain, solves LSTDQ on them alone and sets K ← −Quu⁻¹ Qus. `features`: see
    `bcrl.q.quadratic`. `drop_last` leaves each episode's last step out [released]. A
    gain that is not finite, or pushes away from the goal (a force grows with its
    position), fails its seed.
    """

    iterations: int = 4
    steps: int = 2000  # environment steps of a stage
    noise_std: float = 0.1
    features: str = "products"
    drop_last: bool = True
    evaluation_episodes: int = 50

    name: ClassVar[str] = "lspi"

    @property
    def length(self) -> int:
        """Environment steps of a stage."""
        return self.steps

    def episodes_per_iteration(self, env: Env) -> int:
        """Episodes per iteration; ConfigError unless `steps` are whole ones."""
        whole, rest = divmod(self.steps, self.iterations * env.horizon)
        if rest or not whole:
            why = f"LSPI needs a multiple of {self.iterations} iterations"
            why += f" x {env.horizon} steps"
            raise ConfigError("algorithm.steps", self.steps, why)
        return whole

    def learn(
        self, stage: Stage, start: StageInit, team: SeedBatch, state: Any = None
    ) -> Iterator[StepSnapshot]:
        """Learn an LQ task; yields before the first and after each iteration."""
        env, n = stage.env, len(team.seeds)
        k = env.actions.shape[1]
        failed: dict[int, str] = {}
        done, gain, q = -1, np.zeros((n, k, env.state_dim)), ZERO
        if state is not None:
            done, gain, q, failed = state
        for iteration in range(done + 1, self.iterations + 1):
            if iteration:
                z, after, reward = self._collect(stage, gain, iteration, team)
                theta = [
                    lstdq(*(part[s] for part in (z, after, reward)), env.gamma, self)
                    for s in range(n)
                ]
                m = env.state_dim + k
                q = Quadratic.from_weights(
                    np.stack(theta), self.features, m, env.actions
                )
                for s in range(n):
                    found = improved(q.matrix[s], env)
                    if found is None:
                        why = f"LSPI found no stabilising gain in iteration {iteration}"
                        failed.setdefault(s, why)
                    gain[s] = 0.0 if found is None else found
            yield self._moment(stage, (iteration, gain.copy(), q, dict(failed)))

    def _moment(
        self, stage: Stage, state: tuple[int, NDArray, Q, dict[int, str]]
    ) -> StepSnapshot:
        iteration, gain, q, failed = state
        policy = _linear(gain)  # evaluated without noise, so greedy is the same
        return StepSnapshot(
            stage,
            stage.before + iteration * self.length // self.iterations,
            lambda: state,
            iteration == self.iterations,
            StageResult(q, q),
            policy,
            self.evaluation_episodes,
            np.full(len(gain), np.nan),
            failed=failed,
        )

    def _collect(
        self, stage: Stage, gain: NDArray, iteration: int, team: SeedBatch
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Each seed's (s, a) (S, n, m), next (s', K s') and rewards (S, n)."""
        env, k = stage.env, gain.shape[1]
        episodes = self.episodes_per_iteration(env)
        rngs = [stream(x, "data", stage.number, iteration) for x in team.seeds]
        begin = np.stack([start_states(rng, env, episodes) for rng in rngs])
        shape = (env.horizon, episodes, k + env.step_noise)
        u = np.stack([rng.random(shape) for rng in rngs])
        played = play(env, _linear(gain, self.noise_std), begin, u)
        cut = env.horizon - 1 if self.drop_last else env.horizon
        before, after = played.state[:, :, :cut], played.state[:, :, 1 : cut + 1]
        z = np.concatenate([before, played.action[:, :, :cut]], -1)
        on_policy = np.concatenate([after, _apply(gain, after)], -1)
        n, m = len(gain), z.shape[-1]
        reward = played.reward[:, :, :cut].reshape(n, -1)
        return z.reshape(n, -1, m), on_policy.reshape(n, -1, m), reward


def lstdq(
    z: NDArray, after: NDArray, reward: NDArray, gamma: float, settings: LSPI
) -> NDArray[np.float64]:
    """Weights θ with Φᵀ(Φ − γΦ') θ = Φᵀ r; the pseudo-inverse's if that is singular.

    z and after (n, m) are state-actions and the policy's at the next states. Data that
    overflow give nan.
    """
    phi = features(z, settings.features)
    a = phi.T @ (phi - gamma * features(after, settings.features))
    b = phi.T @ reward
    if not np.isfinite(a).all() or not np.isfinite(b).all():
        return np.full(len(b), np.nan)
    if np.linalg.matrix_rank(a) == len(a):
        return np.linalg.solve(a, b)
    return np.linalg.pinv(a) @ b


def _apply(gain: NDArray, state: NDArray) -> NDArray[np.float64]:
    """K s of states (S, …, d) for gains (S, k, d), shape (S, …, k)."""
    lanes = gain.reshape(len(gain), *[1] * (state.ndim - 2), *gain.shape[1:])
    return (lanes * state[..., None, :]).sum(-1)


def _linear(gain: NDArray, noise_std: float = 0.0) -> Policy:
    """The policy a = K s + N(0, noise_std²), its first uniforms being the noise's."""

    def act(now: NDArray, u: NDArray, alive: NDArray) -> NDArray:
        force = _apply(gain, now)
        return (
            force + noise_std * ndtri(u[..., : gain.shape[1]]) if noise_std else force
        )

    return act


def improved(
    matrix: NDArray[np.float64], env: ContinuousEnv
) -> NDArray[np.float64] | None:
    """K (k, d) = −Quu⁻¹ Qus of Q = zᵀ `matrix` z; None if no K pulls to the goal.

    Force i must not grow with the position that it moves, `env.positions[i]`.
    """
    d = env.state_dim
    try:
        gain = -np.linalg.solve(matrix[d:, d:], matrix[d:, :d])
    except np.linalg.LinAlgError:
        return None
    own = gain[range(len(gain)), env.positions]
    return gain if np.isfinite(gain).all() and own.max() <= 0.0 else None
