"""What DQN does in a step: act, store, learn; S seeds in lockstep."""

import copy
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch

from bcrl.common.seeding import stream
from bcrl.common.serialization import storable
from bcrl.envs import lanes_of
from bcrl.envs.base import Lanes
from bcrl.learning import Floats, Integers
from bcrl.learning.bellman import precompute_target, shaping
from bcrl.learning.distillation import fold
from bcrl.learning.line_search import Searched, search
from bcrl.learning.policies import combined_actions, epsilon_greedy, greedy
from bcrl.learning.replay import Replay, batched, one_by_one
from bcrl.learning.rollout import CHOICES
from bcrl.learning.stage import Pause, SeedBatch, Stage, StepSnapshot
from bcrl.learning.transfer import (
    Acting,
    PolicyReuse,
    ResidualPolicy,
    StageInit,
    StageResult,
)
from bcrl.q.functions import ZERO, Q, add
from bcrl.q.networks.mlp import Adam, DeepQ, Networks, xavier
from bcrl.q.networks.units import InUnits

DRAW_BLOCK = 500  # steps per block; each block has its own random stream


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
    residual: Any = None  # (S, A) ϱ at `env_state`, if computed
    searched: Searched | None = None  # of the base; None: not yet, or α is 1
    #: The arguments of `_target` for each step before the search for α.
    unscaled: list[tuple[Any, ...]] | None = None


@dataclass(eq=False)
class DQNTrainer:
    """S seeds in the middle of a stage, each with its environment and networks."""

    settings: Any  # a `DQN`
    stage: Stage
    start: StageInit
    batch: SeedBatch
    state: Any = None  # the DQNState of a pause; None begins the stage

    def __post_init__(self) -> None:
        self.env, self.n_actions = self.stage.env, self.stage.env.n_actions
        self.state = now = self.state or self._initial_state()
        updater = one_by_one if now.replay.rows.is_cpu else batched
        self._gradient_step = updater(now.deep, now.replay)
        if now.searched is not None:
            self.start = self.start.rescaled(now.searched.alpha)
        self._frozen = self._frozen_at(now.env_state)  # before the present step
        if isinstance(self.start.behavior, ResidualPolicy):
            self._combined = combined_actions(self.env.actions)
        self._block = -1  # the block whose uniforms are drawn

    def _initial_state(self) -> DQNState:
        """The state before the first step; new networks unless warm-started."""
        env, settings, number = self.env, self.settings, self.stage.number
        seeds, device, n = self.batch.seeds, self.batch.device, len(self.batch.seeds)
        rngs = (stream(seed, "exploration", number) for seed in seeds)
        noise = np.stack([rng.random(env.initial_noise) for rng in rngs])
        lanes = lanes_of(env)
        env_state = lanes.begin(env.initial(noise))
        initial = self.start.initial
        if isinstance(initial, InUnits):  # what was folded
            deep = initial.absorbed()
        elif isinstance(initial, DeepQ):
            deep = copy.deepcopy(initial)
        else:
            sizes = (env.state_dim, *settings.hidden, env.n_actions)
            drawn = [xavier(stream(s, "weights", number), sizes) for s in seeds]
            online = Networks(sizes, torch.from_numpy(np.stack(drawn)).to(device))
            adam = Adam.of(online.flat, settings.learning_rate)
            target = Networks(online.sizes, online.flat.clone())
            deep = DeepQ(online, target, adam)
        shape = (n, settings.replay_size, env.state_dim, env.n_actions)
        replay, (steps, decisions) = Replay.empty(*shape, device), np.zeros((2, n), int)
        begun = (deep, replay, lanes, env_state, steps, decisions, np.zeros(n))
        if (alpha := self.start.alpha) == 1.0:
            return DQNState(*begun)
        if isinstance(alpha, str):
            return DQNState(*begun, unscaled=[])
        return DQNState(*begun, searched=Searched.fixed(alpha, n))

    def act(self) -> None:
        """Every seed makes one environment step and stores the transition."""
        env, start, now = self.env, self.start, self.state
        u = self._draws()
        noise = u[:, CHOICES : CHOICES + env.step_noise]
        residual = now.residual
        if residual is None:
            residual = self._values(now.deep, now.env_state)
        epsilon = self.settings.epsilon_at(now.step)
        own, action = self._choose(residual, self._frozen, u, epsilon)
        if isinstance(start.behavior, ResidualPolicy):
            now.n_greedy_decisions += u[:, 0] >= epsilon
        result = now.lanes.step(now.env_state, action, noise)
        next_state, reward, absorbing, cut = result
        base, potential, _ = self._frozen
        frozen = next_base, next_potential, _ = self._frozen_at(next_state)
        bonus: Any = 0.0
        if start.shape is not None:
            before = getattr(env, "before_reset", None)
            if before and start.shape.next_state == "before_reset":
                left = before(now.env_state, action, noise)
                next_potential = self._values(start.potential, left)
            v, next_v = potential.max(-1), next_potential.max(-1)
            zero = start.shape.zero_at_goal
            bonus = shaping(v, next_v, absorbing, env.gamma, zero)
        now_base = base[np.arange(len(own)), own]
        known = (reward, bonus, absorbing, next_base, now_base)
        now.replay.add(now.env_state, next_state, *self._target(*known), own)
        if now.unscaled is not None:
            now.unscaled.append(known)
        now.steps_in_episode += 1
        over = absorbing | cut | (now.steps_in_episode == env.horizon)
        if over.any():
            fresh = env.initial(u[:, CHOICES + env.step_noise :])
            next_state = now.lanes.restart(over, fresh, next_state)
            now.steps_in_episode[over] = 0
            frozen = self._frozen_at(next_state)
        now.env_state, self._frozen = next_state, frozen

    def _draws(self) -> Floats:
        """All uniforms of this step, (S, CHOICES + step_noise + initial_noise)."""
        block, at = divmod(self.state.step, DRAW_BLOCK)
        if block != self._block:
            width, found = CHOICES + self.env.step_noise + self.env.initial_noise, []
            path, batch_size = (self.stage.number, block), self.settings.batch_size
            for purpose, n in (("exploration", width), ("replay", batch_size)):
                rngs = [stream(seed, purpose, *path) for seed in self.batch.seeds]
                found.append(np.stack([rng.random((DRAW_BLOCK, n)) for rng in rngs], 1))
            self._uniforms, picks = found  # (DRAW_BLOCK, S, n)
            self._indices = self.state.replay.indices(picks, at)
            self._block = block
        return self._uniforms[at]

    def _values(self, q: Any, state: Floats) -> Floats:
        """Values (S, A) of a Q-function at one state (S, d) of each seed."""
        return q(state[:, None], self.n_actions)[:, 0]

    def _frozen_at(self, state: Floats) -> tuple[Floats, Floats, Floats]:
        """Values (S, A) of base, potential and prior; each Q is queried once."""
        base = self._values(self.start.base, state)
        potential, prior = (
            base if q is self.start.base else self._values(q, state)
            for q in (self.start.potential, self.start.prior)
        )
        return base, potential, prior

    def _choose(
        self, residual: Any, frozen: Any, u: Floats, epsilon: Any, reuse: Any = True
    ) -> tuple[Integers, Integers]:
        """The own action and the executed one (S, …), from values (S, …, A).

        `frozen`: see `_frozen_at`; `reuse`: lanes in which PPR may follow the prior.
        """
        behavior, now, (base, _, prior) = self.start.behavior, self.state, frozen
        greedy_on = residual + base if self.start.boost.greedy_on == "sum" else residual
        own = epsilon_greedy(greedy_on, u[..., 0], u[..., 1], epsilon)
        if isinstance(behavior, PolicyReuse):
            follow = reuse & (u[..., 2] < behavior.nu**now.step)
            own = np.where(follow, greedy(prior, u[..., 1]), own)
        if not isinstance(behavior, ResidualPolicy):
            return own, own
        advised = greedy(prior, u[..., 2])
        few = now.n_greedy_decisions < behavior.offset  # (S,)
        few = few.reshape(-1, *[1] * (own.ndim - 1))
        own = np.where(few & (u[..., 0] >= epsilon), advised, own)
        return own, self._combined[advised, own]

    def _target(self, reward: Floats, bonus: Any, *rest: Any) -> tuple[Floats, ...]:
        """See `precompute_target`; `bonus` is what shaping adds to the rewards."""
        known = (reward + bonus, *rest, self.env.gamma, self.start.boost)
        return precompute_target(*known)

    def _search(self) -> None:
        """Choose each seed's α by the transitions so far, and restate their targets."""
        now, start = self.state, self.start
        columns = zip(*now.unscaled, strict=True)
        reward, bonus, absorbing, after, base = (np.stack(x, -1) for x in columns)
        after = np.moveaxis(after, 1, 2)  # from (S, A, n); the others are (S, n)
        ends = absorbing & start.boost.mask_at_goal
        each, gamma = zip(reward, base, after, ends, strict=True), self.env.gamma
        found = Searched.of([search(*own, gamma, robust=True) for own in each])
        alpha = found.alpha[:, None]
        bonus = alpha * bonus if start.potential is start.base else bonus
        known = (reward, bonus, absorbing, alpha[..., None] * after, alpha * base)
        now.replay.restate(*self._target(*known)[:2])
        now.searched, now.unscaled = found, None
        self.start = start.rescaled(found.alpha)
        self._frozen = self._frozen_at(now.env_state)

    def update(self) -> None:
        """One gradient step for each seed, each on its batch."""
        if self.state.unscaled is not None:
            self._search()
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
            now.deep.target.flat.copy_(now.deep.online.flat)
            now.replay.valid[:] = False

    def pause(self) -> Pause:
        """The pause after a step, a snapshot if it is time to evaluate."""
        now, trained = self.state, self.state.step - self.settings.random_steps
        due = trained >= 0 and trained % self.settings.evaluate_every == 0
        if due or now.step == self.settings.length:
            return self.snapshot(due)
        return Pause(self.stage, self.stage.before + now.step, now)

    def snapshot(self, due: bool = True) -> StepSnapshot:
        """The present snapshot; one that is `due` starts a new mean of the loss."""
        now, count = self.state, self.stage.before + self.state.step
        weights = torch.isfinite(now.deep.online.flat).all(1).cpu().numpy()
        failed: dict[int, str] = {}
        for part, finite in (("loss", np.isfinite(now.loss)), ("weights", weights)):
            lost = np.flatnonzero(~finite).tolist()
            failed |= dict.fromkeys(lost, f"non-finite {part}")
        loss = now.loss / now.updates if now.updates else now.loss + np.nan
        if due:  # a longer run continues from the state at the end
            now.loss, now.updates = np.zeros_like(loss), 0
        result = StageResult(
            self.start.total(now.deep), now.deep, acting=self._acting()
        )
        policy, folded = partial(self._policy, self.start.base, now.deep), None
        boost, number = self.stage.boost, self.stage.number
        ends = now.step == self.settings.length
        if ends and self.start.base is not ZERO and boost.folds(number):
            known = result, now.deep, now.replay, boost.fold_loss
            result, folded = fold(*known, self.batch.seeds, number)
            policy = partial(self._policy, ZERO, result.q)
        measured = (policy, self.settings.evaluation_episodes, loss)
        failed |= now.lanes.failures  # each seed has one lane
        searched = now.searched
        if now.unscaled is not None and ends:
            searched = Searched.fixed(
                1.0, len(loss), "alpha stays 1: no update was made"
            )
        more = {"searched": searched, "folded": folded, "failed": failed}
        return StepSnapshot(self.stage, count, now, result, *measured, **more)

    def _acting(self) -> Acting:
        """What the greedy policy reads at present."""
        start, now = self.start, self.state
        own: Q = now.deep
        if start.boost.greedy_on == "sum":
            own = add(start.base, own)
        if not isinstance(start.behavior, ResidualPolicy):
            return Acting(own, np.zeros(len(now.loss), bool))
        copying = now.n_greedy_decisions < start.behavior.offset
        return Acting(own, copying, start.prior)

    def _policy(self, base: Q, own: Q, states: Any, u: Floats, alive: Any) -> Integers:
        """A `Policy`: half of the lanes explore, the rest is greedy and without PPR."""
        start, settings = self.start, self.settings
        exploring = np.repeat([True, False], settings.evaluation_episodes)
        epsilon = np.where(exploring, settings.evaluation_epsilon, 0.0)
        residual = own(states, self.n_actions)  # (S, E, A)
        under = prior = base(states, self.n_actions)
        if start.prior is not base:
            prior = start.prior(states, self.n_actions)
        return self._choose(residual, (under, None, prior), u, epsilon, exploring)[1]
