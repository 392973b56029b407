"""A team of seeds in the middle of a DQN stage: acting, replay, updates, copies."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from bcrl.common.seeding import stream
from bcrl.envs import lanes_of
from bcrl.learning.bellman import precompute_target, shaping
from bcrl.learning.dqn_update import updater
from bcrl.learning.policies import combined, epsilon_greedy, greedy
from bcrl.learning.replay import Replay
from bcrl.learning.rollout import CHOICES, Policy
from bcrl.learning.stage import Pause, SeedBatch, Stage, StepSnapshot
from bcrl.learning.transfer import PolicyReuse, ResidualPolicy, StageInit, StageResult
from bcrl.q.functions import Q
from bcrl.q.networks.mlp import Adam, DeepQ, Networks, xavier

if TYPE_CHECKING:
    from bcrl.learning.dqn import DQN

BLOCK = 500  # steps whose uniforms are drawn at a time, from a stream of their own


class DQNTrainer:
    """S seeds, each with its environment, replay, networks and streams."""

    def __init__(
        self,
        settings: DQN,
        stage: Stage,
        start: StageInit,
        team: SeedBatch,
        saved: dict[str, Any] | None = None,
    ) -> None:
        self.settings, self.stage, self.start, self.team = settings, stage, start, team
        self.env = stage.env
        changing = saved or self._fresh()
        vars(self).update(changing)
        self._changing = tuple(changing)
        self._gradient_step = updater(self.deep, self.replay)
        self.table = (
            combined(self.env.actions)
            if isinstance(start.behavior, ResidualPolicy)
            else None
        )
        self.known = self._known(self.state)
        self._all = np.arange(len(team.seeds))
        self._drawn: int | None = None  # the block whose uniforms are at hand

    def _fresh(self) -> dict[str, Any]:
        """All that changes from step to step, before the first."""
        env, seeds, number = self.env, self.team.seeds, self.stage.number
        n = len(seeds)
        begin = np.stack(
            [stream(s, "exploration", number).random(env.initial_noise) for s in seeds]
        )
        shape = (n, self.settings.replay_size, env.state_dim, env.n_actions)
        lanes = lanes_of(env)
        return {
            "step": 0,  # steps done
            "deep": self._networks(),
            "replay": Replay.empty(*shape, self.team.device),
            "ahead": None,  # ϱ's values at the state, if known
            "lanes": lanes,
            "state": lanes.begin(env.initial(begin)),  # (S, d)
            "steps_in_episode": np.zeros(n, np.intp),
            "decisions": np.zeros(n, np.intp),  # not random ones, for RPL's offset
            "loss": np.zeros(n),  # summed over the updates since the last moment
            "updates": 0,
        }

    def saved(self) -> dict[str, Any]:
        """What `_fresh` names, as it is now: enough to go on exactly."""
        return {name: getattr(self, name) for name in self._changing}

    def _networks(self) -> DeepQ:
        """Those of the previous stage, or new ones with the target equal to online."""
        if isinstance(self.start.initial, DeepQ):
            return self.start.initial.clone()
        sizes = (self.env.state_dim, *self.settings.hidden, self.env.n_actions)
        drawn = [
            xavier(stream(seed, "weights", self.stage.number), sizes)
            for seed in self.team.seeds
        ]
        flat = torch.from_numpy(np.stack(drawn)).to(self.team.device)
        online = Networks(sizes, flat)
        optimiser = Adam.of(flat, self.settings.learning_rate)
        return DeepQ(online, online.clone(), optimiser)

    def _ask(self, states: NDArray, *frozen: Q) -> dict[int, NDArray]:
        """Values (S, n, A) of Q-functions at states (S, n, d), each asked once."""
        asked = {id(q): q for q in frozen}
        return {key: q(states, self.env.n_actions) for key, q in asked.items()}

    def _known(self, state: NDArray) -> dict[int, NDArray]:
        """Values (S, A) of base, potential and prior at states (S, d), by id."""
        start = self.start
        values = self._ask(state[:, None], start.base, start.potential, start.prior)
        return {key: each[:, 0] for key, each in values.items()}

    def act(self) -> None:
        """One step of every seed's environment, into its replay."""
        env, start, step = self.env, self.start, self.step
        u = self._draws(step)
        values = self.ahead
        if values is None:
            values = self.deep(self.state[:, None], env.n_actions)[:, 0]
        own_values = self._whole(values, self.known[id(start.base)])
        prior = self.known[id(start.prior)]
        epsilon = self.settings.epsilon_at(step)
        own, action = self._decide(own_values, prior, u, epsilon, step)
        if self.table is not None:
            self.n_greedy_decisions += u[:, 0] >= epsilon
        noise = u[:, CHOICES : CHOICES + env.step_noise]
        after, reward, absorbing, cut = self.lanes.step(self.state, action, noise)
        known = self._known(after)
        if start.shape is not None:
            reward = reward + self._shaping(action, noise, after, absorbing, known)
        base = self.known[id(start.base)][self._all, own]
        fixed, discount, next_base = precompute_target(
            reward,
            absorbing,
            known[id(start.base)],
            base,
            env.gamma,
            start.boost.maxima,
            start.boost.mask_at_goal,
        )
        self.replay.add(self.state, after, next_base, fixed, discount, own)
        self.steps_in_episode += 1
        over = absorbing | cut | (self.steps_in_episode == env.horizon)
        if over.any():
            fresh = env.initial(u[:, CHOICES + env.step_noise :])
            after = self.lanes.restart(over, fresh, after)
            self.steps_in_episode[over] = 0
            known = self._known(after)
        self.state, self.known = after, known

    def _draws(self, step: int) -> NDArray[np.float64]:
        """All uniforms of one step, (S, CHOICES + step_noise + initial_noise)."""
        block, at = divmod(step, BLOCK)
        if block != self._drawn:
            env, number = self.env, self.stage.number
            shape = (BLOCK, CHOICES + env.step_noise + env.initial_noise)
            batches = (BLOCK, self.settings.batch_size)
            drawn, picked = [], []
            for seed in self.team.seeds:
                drawn.append(stream(seed, "exploration", number, block).random(shape))
                picked.append(stream(seed, "replay", number, block).random(batches))
            self._block = np.stack(drawn, 1)
            self._places = self.replay.places(np.stack(picked, 1), at)
            self._drawn = block
        return self._block[at]

    def _whole(self, values: NDArray, base: NDArray) -> NDArray[np.float64]:
        """What the own policy is greedy on, from ϱ's values and base (S, …, A)."""
        return values + base if self.start.boost.greedy_on == "sum" else values

    def _decide(
        self,
        own_values: NDArray,
        prior_values: NDArray,
        u: NDArray,
        epsilon: NDArray | float,
        step: int,
        reuse: NDArray | bool = True,
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """The own action and the executed one, each (S, …), from values (S, …, A).

        `reuse`: the lanes in which PPR may follow the prior.
        """
        own, random = epsilon_greedy(own_values, u[..., 0], u[..., 1], epsilon)
        behavior = self.start.behavior
        if isinstance(behavior, PolicyReuse):
            follow = reuse & (u[..., 2] < behavior.nu**step)
            own = np.where(follow, greedy(prior_values, u[..., 1]), own)
        elif isinstance(behavior, ResidualPolicy):
            prior = greedy(prior_values, u[..., 2])
            copying = self.n_greedy_decisions < behavior.offset
            copying = copying.reshape(-1, *[1] * (own.ndim - 1))
            own = np.where(copying & ~random, prior, own)
            return own, self.table[prior, own]
        return own, own

    def _shaping(
        self,
        action: NDArray,
        noise: NDArray,
        after: NDArray,
        absorbing: NDArray,
        known: dict[int, NDArray],
    ) -> NDArray[np.float64]:
        """What shaping adds to the rewards (S,)."""
        key, shape = id(self.start.potential), self.start.shape
        next_values = known[key]
        if shape.next_state == "before_reset" and hasattr(self.env, "before_reset"):
            left = self.env.before_reset(self.state, action, noise)
            next_values = self._ask(left[:, None], self.start.potential)[key][:, 0]
        return shaping(
            self.known[key].max(-1),
            next_values.max(-1),
            absorbing,
            self.env.gamma,
            shape.zero_at_goal,
        )

    def update(self) -> None:
        """One gradient step of every seed on a batch of its own."""
        at, target_update = self.step % BLOCK, self.settings.target_update
        since = self.deep.steps % target_update
        batches = 1 if at and since else target_update - since  # till the target's next
        loss, self.ahead = self._gradient_step(
            self._places[at : at + batches], self.state
        )
        self.loss += loss
        self.updates += 1

    def end_step(self) -> None:
        """Count a step; every `target_update` steps the target becomes the online."""
        self.step += 1
        self.deep.steps += 1
        if self.deep.steps % self.settings.target_update == 0:
            self.deep.copy_target()
            self.replay.forget()

    def pause(self) -> Pause:
        """The step's end, with what there is to see if it is time to evaluate."""
        if self.settings.is_evaluated(self.step):
            return self.moment()
        return Pause(self.stage, self.stage.before + self.step, self.saved)

    def moment(self) -> StepSnapshot:
        """What there is to see now."""
        lost = ~torch.isfinite(self.deep.online.flat).all(1).cpu().numpy()
        failed = {int(s): "non-finite weights" for s in np.flatnonzero(lost)}
        for s in np.flatnonzero(~np.isfinite(self.loss)):
            failed.setdefault(int(s), "non-finite loss")
        failed |= self.lanes.failures  # one lane per seed
        loss = self.loss / self.updates if self.updates else self.loss + np.nan
        self.loss, self.updates = np.zeros_like(loss), 0
        return StepSnapshot(
            self.stage,
            self.stage.before + self.step,
            self.saved,
            self.step == self.settings.length,
            StageResult(self.start.whole(self.deep), self.deep),
            self._policy(),
            self.settings.evaluation_episodes,
            loss,
            failed=failed,
        )

    def _policy(self) -> Policy:
        """This moment's policy: half of the lanes explore, the others are greedy.

        The greedy ones reuse nothing of the prior (PPR).
        """
        halves = np.repeat([1.0, 0.0], self.settings.evaluation_episodes)
        epsilon, reuse = self.settings.evaluation_epsilon * halves, halves > 0
        step = self.step

        def policy(now: NDArray, u: NDArray, alive: NDArray) -> NDArray:
            frozen = self._ask(now, self.start.base, self.start.prior)
            own_values = self.deep(now, self.env.n_actions)
            own_values = self._whole(own_values, frozen[id(self.start.base)])
            prior = frozen[id(self.start.prior)]
            return self._decide(own_values, prior, u, epsilon, step, reuse)[1]

        return policy
