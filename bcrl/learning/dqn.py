"""Deep Q-network (Mnih et al. 2015) for S seeds in lockstep, plain or boosted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from bcrl.common.seeding import stream
from bcrl.common.serialization import storable
from bcrl.envs import lanes_of
from bcrl.envs.base import Lanes
from bcrl.learning import Booleans, Floats, Integers
from bcrl.learning.bellman import precompute_target, shaping
from bcrl.learning.dqn_update import updater
from bcrl.learning.policies import annealed, combined_actions, greedy, uniform
from bcrl.learning.replay import Replay
from bcrl.learning.rollout import CHOICES, Policy
from bcrl.learning.stage import Pause, SeedBatch, Stage, StepSnapshot
from bcrl.learning.transfer import PolicyReuse, ResidualPolicy, StageInit, StageResult
from bcrl.q.networks.mlp import Adam, DeepQ, Networks, xavier

DRAW_BLOCK = 500  # steps per block; each block has its own random stream


@dataclass(frozen=True)
class DQN:
    """DQN's settings for one stage; steps are environment steps (paper, C.3).

    `random_steps` uniformly random steps come before the `steps`. ε falls from
    `epsilon_start` to `epsilon` within the first `anneal_steps` of the `steps`. Each
    step makes one update once the replay holds more than `learning_starts` transitions.
    Every `target_update` steps, random ones included, the target network is copied.
    """

    steps: int = 10_000
    random_steps: int = 500
    learning_starts: int = 500
    epsilon: float = 0.1
    epsilon_start: float = 0.1
    anneal_steps: int = 0
    target_update: int = 200
    batch_size: int = 32
    replay_size: int = 10_000
    hidden: tuple[int, ...] = (128, 128)
    learning_rate: float = 1e-4
    evaluate_every: int = 1000
    evaluation_episodes: int = 34
    evaluation_epsilon: float = 0.1

    name: ClassVar[str] = "dqn"

    @property
    def length(self) -> int:
        """Environment steps of a stage."""
        return self.random_steps + self.steps

    def epsilon_at(self, step: int) -> float:
        """ε in a step of the stage, counted from 0."""
        trained = step - self.random_steps
        if trained < 0:
            return 1.0
        return annealed(trained, self.epsilon_start, self.epsilon, self.anneal_steps)

    def is_evaluated(self, step: int) -> bool:
        """Whether a snapshot follows `step` steps of a stage."""
        trained = step - self.random_steps
        due = trained >= 0 and trained % self.evaluate_every == 0
        return due or step == self.length

    def learn(
        self, stage: Stage, start: StageInit, batch: SeedBatch, state: Any = None
    ) -> Iterator[Pause]:
        """Learn a stage; yields before the first step and after each.

        Snapshots come before the first step that is not random, after every
        `evaluate_every` steps and after the last.
        """
        run = DQNTrainer(self, stage, start, batch, state)
        if state is None:
            yield run.pause()
        while run.state.step < self.length:
            run.act()
            if run.state.replay.size > self.learning_starts:
                run.update()
            run.end_step()
            yield run.pause()


@storable
@dataclass(eq=False)
class DQNState:
    """All that changes from step to step, and what a checkpoint stores."""

    deep: DeepQ  # ϱ: online and target network, optimiser
    replay: Replay
    lanes: Lanes  # one per seed
    env_state: Floats  # (S, d)
    steps_in_episode: Integers  # (S,)
    n_greedy_decisions: Integers  # (S,) for the offset of `ResidualPolicy`
    loss: Floats  # (S,) summed over the updates since the last snapshot
    updates: int = 0  # since the last snapshot
    step: int = 0  # steps done in this stage
    residual: NDArray | None = None  # (S, A) ϱ at `env_state`, if computed


class FrozenValues(NamedTuple):
    """Values (S, A) of Q-functions that the stage does not change, at `env_state`."""

    base: Floats
    potential: Floats
    prior: Floats


class DQNTrainer:
    """S seeds in the middle of a stage, each with its environment and networks."""

    def __init__(
        self,
        settings: DQN,
        stage: Stage,
        start: StageInit,
        batch: SeedBatch,
        state: DQNState | None = None,
    ) -> None:
        self.settings, self.stage = settings, stage
        self.start, self.batch = start, batch
        self.env, self.n_actions = stage.env, stage.env.n_actions
        self.state = state or self._initial_state()
        self._gradient_step = updater(self.state.deep, self.state.replay)
        self._frozen = self._frozen_at(self.state.env_state)
        if isinstance(start.behavior, ResidualPolicy):
            self._combined = combined_actions(self.env.actions)
        self._block = -1  # the block whose uniforms are drawn

    def _initial_state(self) -> DQNState:
        """The state before the first step; new networks unless warm-started."""
        env, settings, number = self.env, self.settings, self.stage.number
        seeds, device, n = self.batch.seeds, self.batch.device, len(self.batch.seeds)
        rngs = [stream(seed, "exploration", number) for seed in seeds]
        lanes = lanes_of(env)
        noise = np.stack([rng.random(env.initial_noise) for rng in rngs])
        env_state = lanes.begin(env.initial(noise))
        if isinstance(self.start.initial, DeepQ):
            deep = self.start.initial.clone()
        else:
            sizes = (env.state_dim, *settings.hidden, env.n_actions)
            drawn = [xavier(stream(s, "weights", number), sizes) for s in seeds]
            online = Networks(sizes, torch.from_numpy(np.stack(drawn)).to(device))
            adam = Adam.of(online.flat, settings.learning_rate)
            deep = DeepQ(online, online.clone(), adam)
        shape = (n, settings.replay_size, env.state_dim, env.n_actions)
        replay, (steps, decisions) = Replay.empty(*shape, device), np.zeros((2, n), int)
        return DQNState(deep, replay, lanes, env_state, steps, decisions, np.zeros(n))

    def act(self) -> None:
        """Every seed makes one environment step and stores the transition."""
        env, start, now = self.env, self.start, self.state
        u = self._draws()  # (S, CHOICES + step_noise + initial_noise)
        noise = u[:, CHOICES : CHOICES + env.step_noise]
        residual = now.residual  # (S, A)
        if residual is None:
            residual = self._values(now.deep, now.env_state[:, None])[:, 0]
        frozen, epsilon = self._frozen, self.settings.epsilon_at(now.step)
        own, action = self._choose(residual, frozen.base, frozen.prior, u, epsilon)
        if isinstance(start.behavior, ResidualPolicy):
            now.n_greedy_decisions += u[:, 0] >= epsilon
        result = now.lanes.step(now.env_state, action, noise)
        next_state, reward, absorbing, cut = result
        next_frozen = self._frozen_at(next_state)
        if start.shape is not None:
            next_potential = next_frozen.potential
            before = getattr(env, "before_reset", None)
            if before and start.shape.next_state == "before_reset":
                left = before(now.env_state, action, noise)
                next_potential = self._values(start.potential, left[:, None])[:, 0]
            value, next_value = frozen.potential.max(-1), next_potential.max(-1)
            zero_at_goal = start.shape.zero_at_goal
            reward = reward + shaping(
                value, next_value, absorbing, env.gamma, zero_at_goal
            )
        fixed, discount, next_base = precompute_target(
            reward,
            absorbing,
            next_frozen.base,
            frozen.base[np.arange(len(own)), own],
            env.gamma,
            start.boost.maxima,
            start.boost.mask_at_goal,
        )
        now.replay.add(now.env_state, next_state, next_base, fixed, discount, own)
        now.steps_in_episode += 1
        over = absorbing | cut | (now.steps_in_episode == env.horizon)
        if over.any():
            fresh_noise = u[:, CHOICES + env.step_noise :]
            next_state = now.lanes.restart(over, env.initial(fresh_noise), next_state)
            now.steps_in_episode[over] = 0
            next_frozen = self._frozen_at(next_state)
        now.env_state, self._frozen = next_state, next_frozen

    def _draws(self) -> Floats:
        """All uniforms of this step, (S, CHOICES + step_noise + initial_noise)."""
        block, at = divmod(self.state.step, DRAW_BLOCK)
        if block != self._block:
            env, number = self.env, self.stage.number
            shape = (DRAW_BLOCK, CHOICES + env.step_noise + env.initial_noise)
            batches = (DRAW_BLOCK, self.settings.batch_size)

            def drawn(purpose: str, shape: tuple[int, int]) -> Floats:
                rngs = (stream(s, purpose, number, block) for s in self.batch.seeds)
                return np.stack([rng.random(shape) for rng in rngs], 1)

            self._uniforms = drawn("exploration", shape)
            self._indices = self.state.replay.indices(drawn("replay", batches), at)
            self._block = block
        return self._uniforms[at]

    def _values(self, q: Any, states: Floats) -> Floats:
        """Values (S, n, A) of a Q-function at stacked states (S, n, d)."""
        return q(states, self.n_actions)

    def _frozen_at(self, states: Floats) -> FrozenValues:
        """Values of base, potential and prior at states (S, d), each Q queried once."""
        start = self.start
        base = self._values(start.base, states[:, None])[:, 0]
        potential, prior = (
            base if q is start.base else self._values(q, states[:, None])[:, 0]
            for q in (start.potential, start.prior)
        )
        return FrozenValues(base, potential, prior)

    def _choose(
        self,
        residual: NDArray,
        base: Floats,
        prior: Floats,
        u: Floats,
        epsilon: Floats | float,
        reuse: Booleans | bool = True,
    ) -> tuple[Integers, Integers]:
        """The own action and the executed one (S, …), from values (S, …, A).

        `reuse`: the lanes in which PPR may follow the prior.
        """
        behavior, now = self.start.behavior, self.state
        greedy_on = residual + base if self.start.boost.greedy_on == "sum" else residual
        random, choice = u[..., 0] < epsilon, u[..., 1]
        own = np.where(
            random, uniform(self.n_actions, choice), greedy(greedy_on, choice)
        )
        if isinstance(behavior, PolicyReuse):
            follow = reuse & (u[..., 2] < behavior.nu**now.step)
            own = np.where(follow, greedy(prior, u[..., 1]), own)
        if not isinstance(behavior, ResidualPolicy):
            return own, own
        advised = greedy(prior, u[..., 2])
        copying = now.n_greedy_decisions < behavior.offset  # (S,)
        copying = copying.reshape(-1, *[1] * (own.ndim - 1))
        own = np.where(copying & ~random, advised, own)
        return own, self._combined[advised, own]

    def update(self) -> None:
        """One gradient step per seed, each on a separate batch."""
        now, target_update = self.state, self.settings.target_update
        at, since = now.step % DRAW_BLOCK, now.deep.steps % target_update
        # After a copy of the target (or a new block) the batches until the next one.
        batches = 1 if at and since else target_update - since
        indices = self._indices[at : at + batches]  # (T, S, B)
        loss, now.residual = self._gradient_step(indices, now.env_state)
        now.loss += loss
        now.updates += 1

    def end_step(self) -> None:
        """Count a step; every `target_update` steps, copy the online network."""
        now = self.state
        now.step += 1
        now.deep.steps += 1
        if now.deep.steps % self.settings.target_update == 0:
            now.deep.copy_target()
            now.replay.invalidate()

    def pause(self) -> Pause:
        """The pause after a step, a snapshot if it is time to evaluate."""
        if self.settings.is_evaluated(self.state.step):
            return self.snapshot()
        return Pause(self.stage, self.stage.before + self.state.step, self.state)

    def snapshot(self) -> StepSnapshot:
        """The present snapshot; starts a new mean of the loss."""
        now = self.state
        finite = torch.isfinite(now.deep.online.flat).all(1).cpu().numpy()
        failed = {
            int(s): "non-finite loss" for s in np.flatnonzero(~np.isfinite(now.loss))
        }
        failed |= {int(s): "non-finite weights" for s in np.flatnonzero(~finite)}
        failed |= now.lanes.failures  # one lane per seed
        loss = now.loss / now.updates if now.updates else now.loss + np.nan
        now.loss, now.updates = np.zeros_like(loss), 0
        return StepSnapshot(
            self.stage,
            self.stage.before + now.step,
            now,
            StageResult(self.start.total(now.deep), now.deep),
            self._evaluated_policy(),
            self.settings.evaluation_episodes,
            loss,
            failed=failed,
        )

    def _evaluated_policy(self) -> Policy:
        """The present policy: half of the lanes explore, the other half is greedy.

        Greedy lanes do not reuse the prior (PPR).
        """
        exploring = np.repeat([True, False], self.settings.evaluation_episodes)
        epsilon = np.where(exploring, self.settings.evaluation_epsilon, 0.0)
        start = self.start

        def policy(states: NDArray, u: NDArray, alive: NDArray) -> NDArray:
            base = self._values(start.base, states)  # (S, E, A)
            same = start.prior is start.base
            prior = base if same else self._values(start.prior, states)
            residual = self._values(self.state.deep, states)
            return self._choose(residual, base, prior, u, epsilon, exploring)[1]

        return policy
