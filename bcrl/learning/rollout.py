"""Episodes of many seeds in lockstep, for data collection and evaluation."""

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bcrl.envs import Env, Success, is_finite, lanes_of
from bcrl.envs.base import FiniteEnv
from bcrl.learning import Booleans, Floats, Integers
from bcrl.learning.policies import greedy, walk
from bcrl.q.functions import NOT_FINITE, Q, Table, query, rows_of

AT_ONCE = (4, 32)  # seeds, and episodes of each, whose simulators exist at a time
CHOICES = 3  # uniforms per decision of DQN: explore? which action? the prior's action


@dataclass(frozen=True)
class Episodes:
    """E episodes of each of S seeds, at most T steps long; void from `length` on."""

    state: Floats  # (S, E, T + 1, d)
    action: Integers  # (S, E, T)
    reward: Floats  # (S, E, T)
    absorbing: Booleans  # (S, E, T)
    length: Integers  # (S, E)
    start: Floats  # (S, E, …) what `env.initial` gave
    #: Seeds, by index, whose simulator or Q failed, and why: their episodes are void.
    failed: dict[int, str] = field(default_factory=dict)
    reported: Booleans | None = None  # (S, E) success as simulators report it

    def discounted_return(self, gamma: float) -> Floats:
        """Σ_t γ^t r_t of each episode, shape (S, E)."""
        return (self.reward * gamma ** np.arange(self.reward.shape[-1])).sum(-1)

    def solved(self, success: Success | str = "unpunished") -> Booleans:
        """Whether each episode was a success by a rule of `env.success`, (S, E)."""
        rule, threshold = Success(success) if isinstance(success, str) else success
        last = (*np.indices(self.length.shape), np.maximum(self.length - 1, 0))
        ended, reward = self.absorbing[last], self.reward[last]
        outcomes: dict[str, Any] = {
            "absorbed": ended,
            "survived": ~ended,
            "rewarded": ended & (reward > 0.0),
            "threshold": self.reward.sum(-1) >= threshold,
            "info": self.reported,
        }
        return outcomes.get(rule, ended & (reward >= 0.0))


def starts_and_draws(
    rngs: Sequence[np.random.Generator], env: Env, episodes: int, choices: int = 2
) -> tuple[Floats, Floats]:
    """Random starts (S, E, d) by `env.initial`, and then `draws` (S, T, E, …)."""
    noise = np.stack([rng.random((episodes, env.initial_noise)) for rng in rngs])
    return env.initial(noise), draws(rngs, env, episodes, choices)


def draws(
    rngs: Sequence[np.random.Generator], env: Env, episodes: int, choices: int = 2
) -> Floats:
    """All uniforms of S seeds' episodes, (S, T, E, choices + step_noise).

    Entry 0 decides whether to explore, entry 1 picks the random action or breaks ties,
    the last ones are the environment's noise. Unused ones are drawn, too.
    """
    shape = (env.horizon, episodes, choices + env.step_noise)
    return np.stack([rng.random(shape) for rng in rngs])


def success_of(env: Env) -> Success:
    """The rule by which an episode in `env` is a success."""
    threshold = getattr(env, "success_threshold", None)
    return Success(getattr(env, "success", "unpunished"), threshold or 0.0)


#: (states (S, E, d), uniforms (S, E, 2 or more), mask (S, E)) → actions (S, E), or
#: forces (S, E, k) for an env's `push`. Only the lanes in the mask count.
Policy = Callable[[NDArray, NDArray, NDArray], NDArray]


def rollout(env: Env, q: Q, start: Floats, u: Floats, epsilon: float = 0.0) -> Episodes:
    """ε-greedy episodes from start (S, E, d) with uniforms u (S, T, E, 2 + noise)."""
    if is_finite(env) and isinstance(q, Table):
        return _tabular_rollout(env, q, start, u, epsilon)
    failed: dict[int, str] = {}

    def epsilon_greedy(states: NDArray, u: NDArray, alive: NDArray) -> NDArray:
        action = (u[..., 1] * env.n_actions).astype(np.intp)
        exploit = alive & (u[..., 0] >= epsilon)
        if exploit.any():  # Q may be expensive: query it only where it decides
            queried = [x[lanes] for x, lanes in zip(states, exploit, strict=True)]
            values, lost = query(q, queried, env.n_actions)
            failed.update(lost | failed)
            action[exploit] = greedy(np.concatenate(values), u[..., 1][exploit])
        return action

    episodes = play(env, epsilon_greedy, start, u)
    return replace(episodes, failed=failed | episodes.failed)


def play(env: Env, policy: Policy, start: Floats, u: Floats) -> Episodes:
    """Episodes from start (S, E, d); the last of u (S, T, E, …) are the env's noise."""
    n_seeds, horizon, n_episodes, width = u.shape
    shape = (horizon, n_seeds, n_episodes)  # a step's values are close in memory
    state = np.zeros((horizon + 1, *shape[1:], env.state_dim))
    action: NDArray = np.zeros(0)  # its shape and type are the policy's
    reward, absorbing = np.zeros(shape), np.zeros(shape, bool)
    length, reported = np.zeros(shape[1:], np.intp), None
    failed: dict[int, str] = {}
    # Few simulators run at the same time; the policy always sees the states of all.
    lanes = lanes_of(env)
    costly = getattr(lanes, "costly", True)  # a user's lanes may not say
    seeds, each = AT_ONCE if costly else (n_seeds, n_episodes)
    parts = itertools.product(range(0, n_seeds, seeds), range(0, n_episodes, each))
    for s, e in parts:
        part = (slice(s, s + seeds), slice(e, e + each))
        state[0][part] = lanes.begin(start[part])
        alive = np.zeros(shape[1:], bool)
        alive[part] = True
        for t in range(horizon):
            choice = policy(state[t], u[:, t], alive)
            if not action.size:
                action = np.zeros((*shape, *choice.shape[2:]), choice.dtype)
            running, now = alive[part], state[t][part]
            # A mask copies, slices do not.
            live = (slice(None), slice(None)) if running.all() else (running.copy(),)
            noise = u[:, t, :, width - env.step_noise :][part][live]
            result = lanes.step(now[live], choice[part][live], noise, live)
            action[t][part] = choice[part]
            state[t + 1][part] = now
            state[t + 1][part][live] = result[0]
            reward[t][part][live], absorbing[t][part][live] = result[1:3]
            length[part][live] += 1
            running[live] = ~(result[2] | result[3])
            if not running.any():
                break
        if (succeeded := getattr(lanes, "succeeded", None)) is not None:
            reported = np.zeros(shape[1:], bool) if reported is None else reported
            reported[part] = succeeded
        lanes.close()
        lost, n = lanes.failures.items(), start[part].shape[1]
        failed = {s + lane // n: why for lane, why in lost} | failed
    state, action, reward, absorbing = (
        # Contiguous, because sums over strided axes depend on the number of lanes.
        np.ascontiguousarray(np.moveaxis(part, 0, 2))
        for part in (state, action, reward, absorbing)
    )
    return Episodes(state, action, reward, absorbing, length, start, failed, reported)


@functools.lru_cache(maxsize=64)
def transition_tables(env: FiniteEnv) -> tuple[Integers, Floats, Booleans]:
    """Next row, reward and absorption of a finite deterministic env, each (N, A)."""
    every = np.repeat(env.states()[:, None], env.n_actions, axis=1)
    actions = np.broadcast_to(np.arange(env.n_actions), every.shape[:2])
    after, reward, absorbing = env.step(every, actions)
    return rows_of(env, after), reward, absorbing


def _tabular_rollout(
    env: FiniteEnv, q: Table, start: NDArray, u: NDArray, epsilon: float
) -> Episodes:
    """`rollout` on a finite environment, row by row in compiled code."""
    tables, first = transition_tables(env), rows_of(env, start)
    seeds = zip(q.values, first, u, strict=True)
    walked = [walk(*tables, *seed, epsilon) for seed in seeds]
    row, action, length = (np.stack(part) for part in zip(*walked, strict=True))
    void = np.arange(u.shape[1]) >= length[..., None]
    reward, absorbing = (table[row[..., :-1], action] for table in tables[1:])
    reward[void], absorbing[void] = 0.0, False
    bad = [s for s, values in enumerate(q.values) if not np.isfinite(values).all()]
    failed = dict.fromkeys(bad, NOT_FINITE)
    return Episodes(env.states()[row], action, reward, absorbing, length, start, failed)
