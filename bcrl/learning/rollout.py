"""Episodes of many seeds in lockstep: collecting data and evaluating policies."""

from __future__ import annotations

import functools
from collections import ChainMap
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from bcrl.envs import Env, Success, is_finite, is_simulated, lanes_of
from bcrl.learning.policies import greedy, uniform, walk
from bcrl.q.functions import NOT_FINITE, Q, Table, ask, rows_of

AT_ONCE = 128  # simulators that exist at a time in `play`,
EPISODES = 32  # of which so many have the same seed
CHOICES = 3  # uniforms a step-wise decision takes: explore? which action? the prior's


@dataclass(frozen=True)
class Episodes:
    """E episodes of each of S seeds, at most T steps long; from `length` on void."""

    state: NDArray[np.float64]  # (S, E, T + 1, d)
    action: NDArray[np.intp]  # (S, E, T)
    reward: NDArray[np.float64]  # (S, E, T)
    absorbing: NDArray[np.bool_]  # (S, E, T)
    length: NDArray[np.intp]  # (S, E)
    start: NDArray[np.float64]  # (S, E, …) what `env.initial` gave
    #: Seeds, by place, whose simulator or Q failed, and why: their episodes are void.
    failed: dict[int, str] = field(default_factory=dict)
    reported: NDArray[np.bool_] | None = None  # (S, E) success, as a simulator says

    def discounted_return(self, gamma: float) -> NDArray[np.float64]:
        """Σ_t γ^t r_t of each episode, shape (S, E)."""
        steps = np.arange(self.reward.shape[-1])
        return (self.reward * gamma**steps).sum(-1)

    def solved(self, success: Success | str = "unpunished") -> NDArray[np.bool_]:
        """Whether each episode was a success by a rule of `env.success`, (S, E)."""
        rule, threshold = Success(success) if isinstance(success, str) else success
        last = np.maximum(self.length - 1, 0)[..., None]
        ended = np.take_along_axis(self.absorbing, last, -1)[..., 0]
        reward = np.take_along_axis(self.reward, last, -1)[..., 0]
        match rule:
            case "absorbed":
                return ended
            case "survived":
                return ~ended
            case "rewarded":
                return ended & (reward > 0.0)
            case "threshold":
                return self.reward.sum(-1) >= threshold
            case "info":
                return self.reported
        return ended & (reward >= 0.0)


def draws(rng: np.random.Generator, env: Env, episodes: int) -> NDArray[np.float64]:
    """All uniforms of one seed's episodes, shape (T, E, 2 + step_noise).

    Entry 0 decides whether to explore, entry 1 picks the random action or breaks ties,
    the rest is the environment's noise. Every lane has its draws, used or not.
    """
    return rng.random((env.horizon, episodes, 2 + env.step_noise))


def start_states(
    rng: np.random.Generator, env: Env, episodes: int
) -> NDArray[np.float64]:
    """Where one seed's episodes start, as `env.initial` says, shape (E, d)."""
    return env.initial(rng.random((episodes, env.initial_noise)))


def evaluation_starts(rng: np.random.Generator, env: Env) -> NDArray[np.float64]:
    """Where FQI's greedy policy is evaluated from: set states, or random ones."""
    if is_simulated(env):
        return start_states(rng, env, env.starts)
    return env.evaluation_states()


def success_of(env: Env) -> Success:
    """What `Episodes.solved` takes for a success in `env`."""
    threshold = getattr(env, "success_threshold", None)
    return Success(getattr(env, "success", "unpunished"), threshold or 0.0)


#: Actions (S, E) at states (S, E, d), from uniforms (S, E, 2 or more); only the lanes
#: in the mask (S, E) count. Forces (S, E, k) go to an env's `push`.
Policy = Callable[[NDArray, NDArray, NDArray], NDArray]


def rollout(
    env: Env,
    q: Q,
    start: NDArray[np.float64],
    u: NDArray[np.float64],
    epsilon: float = 0.0,
) -> Episodes:
    """ε-greedy episodes from start (S, E, d) with uniforms u (S, T, E, 2 + noise)."""
    if is_finite(env) and isinstance(q, Table):
        return _tabular_rollout(env, q, start, u, epsilon)
    failed: dict[int, str] = {}

    def epsilon_greedy(now: NDArray, u: NDArray, alive: NDArray) -> NDArray:
        act = uniform(env.n_actions, u[..., 1])
        exploit = alive & (u[..., 0] >= epsilon)
        if exploit.any():  # Q may be dear: ask it only where it decides
            asked = [x[lanes] for x, lanes in zip(now, exploit, strict=True)]
            values, lost = ask(q, asked, env.n_actions)
            failed.update(lost | failed)
            act[exploit] = greedy(np.concatenate(values), u[..., 1][exploit])
        return act

    played = play(env, epsilon_greedy, start, u)
    return replace(played, failed=failed | played.failed)


def play(
    env: Env, policy: Policy, start: NDArray[np.float64], u: NDArray[np.float64]
) -> Episodes:
    """Episodes from start (S, E, d); the last of u (S, T, E, …) are the env's noise."""
    n_seeds, n_episodes, _ = start.shape
    # Which rows Q is asked for together must not depend on the number of seeds.
    episodes = min(EPISODES, AT_ONCE)
    seeds = AT_ONCE // episodes
    if is_simulated(env) and (n_episodes > episodes or n_seeds > seeds):
        return _in_parts(env, policy, start, u, seeds, episodes)
    horizon, noise = u.shape[1], u.shape[-1] - env.step_noise
    lanes_of_a_step = (horizon, n_seeds, n_episodes)  # what is written at once is close
    running = lanes_of(env)
    first = running.begin(start)
    state = np.zeros((horizon + 1, *first.shape))
    state[0] = first
    action = None
    reward = np.zeros(lanes_of_a_step)
    absorbing = np.zeros(lanes_of_a_step, bool)
    length = np.zeros((n_seeds, n_episodes), np.intp)
    alive = np.ones((n_seeds, n_episodes), bool)
    for t in range(horizon):
        now = state[t]
        act = policy(now, u[:, t], alive)
        if action is None:
            action = np.zeros((*lanes_of_a_step, *act.shape[2:]), act.dtype)
        # Boolean masks copy; as long as all lanes live there is no need of one.
        lanes = (slice(None), slice(None)) if alive.all() else (alive,)
        length[lanes] += 1
        action[t] = act
        after, r, done, cut = running.step(
            now[lanes], act[lanes], u[:, t, :, noise:][lanes], lanes
        )
        state[t + 1] = now
        state[t + 1][lanes] = after
        reward[t][lanes], absorbing[t][lanes] = r, done
        alive[lanes] = ~(done | cut)
        if not alive.any():
            break
    parts = (state, action, reward, absorbing)
    # Copied, for sums over strides would depend on how many lanes there are.
    by_lane = [np.ascontiguousarray(np.moveaxis(part, 0, 2)) for part in parts]
    reported = getattr(running, "succeeded", None)
    running.close()
    failed = {lane // n_episodes: why for lane, why in running.failures.items()}
    return Episodes(*by_lane, length, start, failed, reported)


def _in_parts(
    env: Env, policy: Policy, start: NDArray, u: NDArray, seeds: int, episodes: int
) -> Episodes:
    """`play`, with so many seeds and episodes of each at a time.

    The policy sees the arrays of all of them, and so decides as it would for all.
    """

    def part(seed: int, episode: int) -> Episodes:
        at = np.s_[seed : seed + seeds, episode : episode + episodes]

        def decide(*own: NDArray) -> NDArray:  # states, uniforms, alive
            whole = [np.zeros((*start.shape[:2], *x.shape[2:]), x.dtype) for x in own]
            for everything, x in zip(whole, own, strict=True):
                everything[at] = x
            return policy(*whole)[at]

        played = play(env, decide, start[at], u[at[0], :, at[1]])
        failed = {seed + place: why for place, why in played.failed.items()}
        return replace(played, failed=failed)

    n_seeds, n_episodes, _ = start.shape
    grid = [
        [part(seed, episode) for episode in range(0, n_episodes, episodes)]
        for seed in range(0, n_seeds, seeds)
    ]
    joined: dict = {}
    for name in (each.name for each in fields(Episodes)):
        values = [[getattr(each, name) for each in row] for row in grid]
        if isinstance(values[0][0], dict):  # by seed
            joined[name] = dict(ChainMap(*(each for row in values for each in row)))
        elif values[0][0] is not None:
            joined[name] = np.concatenate([np.concatenate(row, 1) for row in values])
    return Episodes(**joined)


@functools.lru_cache(maxsize=64)
def transition_tables(
    env: Env,
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.bool_]]:
    """Next row, reward and absorption of a finite deterministic env, each (N, A)."""
    states = env.states()
    every = np.repeat(states[:, None], env.n_actions, axis=1)
    actions = np.broadcast_to(np.arange(env.n_actions), every.shape[:2])
    after, reward, absorbing = env.step(every, actions)
    return rows_of(env, after), reward, absorbing


def _tabular_rollout(
    env: Env, q: Table, start: NDArray, u: NDArray, epsilon: float
) -> Episodes:
    """`rollout` on a finite environment, walked row by row in compiled code."""
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
    finite = [np.isfinite(values).all() for values in q.values]
    failed = {s: NOT_FINITE for s, known in enumerate(finite) if not known}
    return Episodes(env.states()[row], action, reward, absorbing, length, start, failed)
