"""Episodes of many seeds in lockstep, for data collection and evaluation."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bcrl.envs import Env, Success, is_finite, is_simulated, lanes_of
from bcrl.envs.base import FiniteEnv
from bcrl.learning import Booleans, Floats, Integers
from bcrl.learning.policies import greedy, uniform, walk
from bcrl.q.functions import NOT_FINITE, Q, Table, query, rows_of

AT_ONCE = 128  # simulators that exist at a time in `play`,
EPISODES = 32  # at most this many of them for one seed
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
        steps = np.arange(self.reward.shape[-1])
        return (self.reward * gamma**steps).sum(-1)

    def solved(self, success: Success | str = "unpunished") -> Booleans:
        """Whether each episode was a success by a rule of `env.success`, (S, E)."""
        rule, threshold = Success(success) if isinstance(success, str) else success
        last = np.maximum(self.length - 1, 0)[..., None]
        ended = np.take_along_axis(self.absorbing, last, -1)[..., 0]
        reward = np.take_along_axis(self.reward, last, -1)[..., 0]
        outcomes: dict[str, Any] = {
            "absorbed": ended,
            "survived": ~ended,
            "rewarded": ended & (reward > 0.0),
            "threshold": self.reward.sum(-1) >= threshold,
            "info": self.reported,
        }
        return outcomes.get(rule, ended & (reward >= 0.0))


def draws(
    rng: np.random.Generator, env: Env, episodes: int, choices: int = 2
) -> Floats:
    """All uniforms of one seed's episodes, shape (T, E, choices + step_noise).

    Entry 0 decides whether to explore, entry 1 picks the random action or breaks ties,
    the last ones are the environment's noise. Unused ones are drawn, too.
    """
    return rng.random((env.horizon, episodes, choices + env.step_noise))


def start_states(rng: np.random.Generator, env: Env, episodes: int) -> Floats:
    """Random starts of one seed's episodes, by `env.initial`, shape (E, d)."""
    return env.initial(rng.random((episodes, env.initial_noise)))


def starts_and_draws(
    rngs: Sequence[np.random.Generator], env: Env, episodes: int, choices: int = 2
) -> tuple[Floats, Floats]:
    """`start_states` (S, E, d) and then `draws` (S, T, E, …) of S seeds."""
    start = np.stack([start_states(rng, env, episodes) for rng in rngs])
    return start, np.stack([draws(rng, env, episodes, choices) for rng in rngs])


def evaluation_starts(rng: np.random.Generator, env: Env) -> Floats:
    """Starts (E, d) of FQI's greedy evaluation: fixed, but a simulator's are random."""
    if is_simulated(env):
        return start_states(rng, env, env.starts)
    return env.evaluation_states()


def success_of(env: Env) -> Success:
    """The rule by which an episode in `env` is a success."""
    threshold = getattr(env, "success_threshold", None)
    return Success(getattr(env, "success", "unpunished"), threshold or 0.0)


#: (states (S, E, d), uniforms (S, E, 2 or more), mask (S, E)) → actions (S, E), or
#: forces (S, E, k) for an env's `push`. Only the lanes in the mask count.
Policy = Callable[[NDArray, NDArray, NDArray], NDArray]


def rollout(
    env: Env,
    q: Q,
    start: Floats,
    u: Floats,
    epsilon: float = 0.0,
) -> Episodes:
    """ε-greedy episodes from start (S, E, d) with uniforms u (S, T, E, 2 + noise)."""
    if is_finite(env) and isinstance(q, Table):
        return _tabular_rollout(env, q, start, u, epsilon)
    failed: dict[int, str] = {}

    def epsilon_greedy(states: NDArray, u: NDArray, alive: NDArray) -> NDArray:
        action = uniform(env.n_actions, u[..., 1])
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
    length = np.zeros(shape[1:], np.intp)
    failed: dict[int, str] = {}
    reported = None
    for part in _parts(env, n_seeds, n_episodes):
        lanes = lanes_of(env)
        state[0][part] = lanes.begin(start[part])
        alive = np.zeros(shape[1:], bool)
        alive[part] = True
        for t in range(horizon):
            choice = policy(state[t], u[:, t], alive)
            if not action.size:
                action = np.zeros((*shape, *choice.shape[2:]), choice.dtype)
            running = alive[part]
            # A mask copies, slices do not.
            live = (slice(None), slice(None)) if running.all() else (running.copy(),)
            noise = u[:, t, :, width - env.step_noise :][part]
            now = state[t][part]
            after, r, done, cut = lanes.step(
                now[live], choice[part][live], noise[live], live
            )
            action[t][part] = choice[part]
            state[t + 1][part] = now
            state[t + 1][part][live] = after
            reward[t][part][live], absorbing[t][part][live] = r, done
            length[part][live] += 1
            running[live] = ~(done | cut)
            if not running.any():
                break
        if (succeeded := getattr(lanes, "succeeded", None)) is not None:
            reported = np.zeros(shape[1:], bool) if reported is None else reported
            reported[part] = succeeded
        lanes.close()
        first_seed, in_part = part[0].start or 0, start[part].shape[1]
        failures = lanes.failures.items()
        failed = {first_seed + lane // in_part: why for lane, why in failures} | failed
    state, action, reward, absorbing = (
        # Contiguous, because sums over strided axes depend on the number of lanes.
        np.ascontiguousarray(np.moveaxis(part, 0, 2))
        for part in (state, action, reward, absorbing)
    )
    return Episodes(state, action, reward, absorbing, length, start, failed, reported)


def _parts(env: Env, n_seeds: int, n_episodes: int) -> list[tuple[slice, slice]]:
    """Lanes (seeds, episodes) that run at the same time: all, but few simulators.

    The states that Q is queried at together must not depend on the number of seeds.
    """
    if not is_simulated(env):
        return [(slice(None), slice(None))]
    episodes = min(EPISODES, AT_ONCE)
    seeds = AT_ONCE // episodes
    corners = itertools.product(
        range(0, n_seeds, seeds), range(0, n_episodes, episodes)
    )
    return [(slice(s, s + seeds), slice(e, e + episodes)) for s, e in corners]


@functools.lru_cache(maxsize=64)
def transition_tables(
    env: FiniteEnv,
) -> tuple[Integers, Floats, Booleans]:
    """Next row, reward and absorption of a finite deterministic env, each (N, A)."""
    states = env.states()
    every = np.repeat(states[:, None], env.n_actions, axis=1)
    actions = np.broadcast_to(np.arange(env.n_actions), every.shape[:2])
    after, reward, absorbing = env.step(every, actions)
    return rows_of(env, after), reward, absorbing


def _tabular_rollout(
    env: FiniteEnv, q: Table, start: NDArray, u: NDArray, epsilon: float
) -> Episodes:
    """`rollout` on a finite environment, row by row in compiled code."""
    tables = transition_tables(env)
    first = rows_of(env, start)
    walked = [
        walk(*tables, values, first[s], u[s], epsilon)
        for s, values in enumerate(q.values)
    ]
    row, action, length = (np.stack(part) for part in zip(*walked, strict=True))
    void = np.arange(u.shape[1]) >= length[..., None]
    _, reward, absorbing = (table[row[..., :-1], action] for table in tables)
    reward[void], absorbing[void] = 0.0, False
    bad = [s for s, values in enumerate(q.values) if not np.isfinite(values).all()]
    failed = dict.fromkeys(bad, NOT_FINITE)
    return Episodes(env.states()[row], action, reward, absorbing, length, start, failed)
