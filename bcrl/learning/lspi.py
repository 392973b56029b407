"""Least-squares policy iteration with quadratic features (Lagoudakis and Parr 2003)."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from bcrl.common.arrays import ndtri
from bcrl.common.seeding import stream
from bcrl.common.serialization import storable
from bcrl.envs.base import ContinuousEnv, Env
from bcrl.errors import ConfigError
from bcrl.learning import Floats
from bcrl.learning.rollout import play, starts_and_draws
from bcrl.learning.stage import SeedBatch, Stage, StepSnapshot
from bcrl.learning.transfer import StageInit, StageResult
from bcrl.q.functions import ZERO, Q
from bcrl.q.quadratic import Quadratic, features


@storable
@dataclass(frozen=True)
class LSPIState:
    """What LSPI needs to resume after an iteration."""

    iteration: int
    gain: Floats  # (S, k, d) K of the policy a = K s
    q: Q
    failed: dict[int, str]  # seeds without a stabilising gain, by index, and why


@dataclass(frozen=True)
class LSPI:
    """Policy iteration on a = K s + noise, initially K = 0 (paper, C.3).

    Each iteration collects its share of the `steps` in whole episodes with the current
    gain, solves LSTDQ on these alone and sets K ← −Quu⁻¹ Qus. `features`: see
    `bcrl.q.quadratic`. `drop_last` leaves each episode's last step out [released].
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
        """Episodes per iteration; ConfigError unless `steps` are whole episodes."""
        episodes, rest = divmod(self.steps, self.iterations * env.horizon)
        if rest or not episodes:
            why = f"must be a multiple of {self.iterations} x {env.horizon} for LSPI"
            raise ConfigError("algorithm.steps", self.steps, why)
        return episodes

    def learn(
        self, stage: Stage, start: StageInit, batch: SeedBatch, state: Any = None
    ) -> Iterator[StepSnapshot]:
        """Learn an LQ task; yields before the first and after each iteration."""
        env: Any = stage.env
        n, d, k = len(batch.seeds), env.state_dim, env.actions.shape[1]
        if state is None:
            state = LSPIState(0, np.zeros((n, k, d)), ZERO, {})
            yield self._snapshot(stage, state)
        for i in range(state.iteration + 1, self.iterations + 1):
            transitions = zip(*self._collect(stage, state.gain, i, batch), strict=True)
            theta = np.stack([lstdq(*x, env.gamma, self.features) for x in transitions])
            q = Quadratic.from_weights(theta, self.features, d + k, env.actions)
            better = [improved(matrix, env) for matrix in q.matrix]
            gain = np.stack([np.zeros((k, d)) if x is None else x for x in better])
            why = f"LSPI found no stabilising gain in iteration {i}"
            failed = {s: why for s, x in enumerate(better) if x is None} | state.failed
            state = LSPIState(i, gain, q, failed)
            yield self._snapshot(stage, state)

    def _snapshot(self, stage: Stage, state: LSPIState) -> StepSnapshot:
        count = stage.before + state.iteration * self.length // self.iterations
        result, loss = StageResult(state.q, state.q), np.full(len(state.gain), np.nan)
        policy = partial(_act, state.gain, 0.0)  # no noise, so both halves are greedy
        measured = (policy, self.evaluation_episodes, loss)
        return StepSnapshot(stage, count, state, result, *measured, failed=state.failed)

    def _collect(
        self, stage: Stage, gain: Floats, iteration: int, batch: SeedBatch
    ) -> tuple[Floats, Floats, Floats]:
        """Each seed's (s, a) (S, n, m), next (s', K s') and rewards (S, n)."""
        env, (seeds, k, d) = stage.env, gain.shape
        rngs = [stream(x, "data", stage.number, iteration) for x in batch.seeds]
        start, u = starts_and_draws(rngs, env, self.episodes_per_iteration(env), k)
        played = play(env, partial(_act, gain, self.noise_std), start, u)
        n = env.horizon - self.drop_last
        state = played.state[:, :, :n].reshape(seeds, -1, d)
        next_state = played.state[:, :, 1 : n + 1].reshape(seeds, -1, d)
        action = played.action[:, :, :n].reshape(seeds, -1, k)
        z = np.concatenate([state, action], -1)
        next_z = np.concatenate([next_state, _act(gain, 0.0, next_state)], -1)
        return z, next_z, played.reward[:, :, :n].reshape(seeds, -1)


def lstdq(z: Floats, next_z: Floats, reward: Floats, gamma: float, kind: str) -> Floats:
    """θ (F,) with Φᵀ(Φ − γΦ') θ = Φᵀ r, by the pseudo-inverse if that is singular.

    z and next_z (n, m): state-actions, and next states with the policy's actions;
    kind: of the `features`. Data that overflow give nan.
    """
    phi = features(z, kind)  # (n, F)
    a = phi.T @ (phi - gamma * features(next_z, kind))
    b = phi.T @ reward
    if not np.isfinite(a).all() or not np.isfinite(b).all():
        return np.full(len(b), np.nan)
    full = np.linalg.matrix_rank(a) == len(a)
    theta: Any = np.linalg.solve(a, b) if full else np.linalg.pinv(a) @ b
    return theta


def _act(
    gain: Floats, noise_std: float, states: Floats, u: Any = None, alive: Any = None
) -> Floats:
    """The `Policy` a = K s + N(0, noise_std²); its first uniforms are the noise's."""
    force = (gain[:, None] * states[..., None, :]).sum(-1)
    return force + noise_std * ndtri(u[..., : gain.shape[1]]) if noise_std else force


def improved(matrix: Floats, env: ContinuousEnv) -> Floats | None:
    """K (k, d) = −Quu⁻¹ Qus of Q = zᵀ `matrix` z; None unless K pulls to the goal.

    Force i must not grow with the position that it moves, `env.positions[i]`.
    """
    d = env.state_dim
    try:
        gain: Any = -np.linalg.solve(matrix[d:, d:], matrix[d:, :d])
    except np.linalg.LinAlgError:
        return None
    own = gain[range(len(gain)), env.positions]
    return gain if np.isfinite(gain).all() and own.max() <= 0.0 else None
