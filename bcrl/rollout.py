"""Episodes of many seeds in lockstep: collecting data and evaluating policies."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bcrl.compiling import kept
from bcrl.envs import Env, is_finite, is_simulated, lanes_of
from bcrl.policies import greedy, uniform
from bcrl.q import Q, Table

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

    def discounted_return(self, gamma: float) -> NDArray[np.float64]:
        """Σ_t γ^t r_t of each episode, shape (S, E)."""
        steps = np.arange(self.reward.shape[-1])
        return (self.reward * gamma**steps).sum(-1)

    def solved(self, success: str = "unpunished") -> NDArray[np.bool_]:
        """Whether each episode was a success, shape (S, E).

        That is to be absorbed, `unpunished` or however (`absorbed`), or to have lasted
        to the horizon (`survived`).
        """
        last = np.maximum(self.length - 1, 0)[..., None]
        ended = np.take_along_axis(self.absorbing, last, -1)[..., 0]
        if success == "survived":
            return ~ended & (self.length == self.reward.shape[-1])
        if success == "absorbed":
            return ended
        return ended & (np.take_along_axis(self.reward, last, -1)[..., 0] >= 0.0)


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


def success_of(env: Env) -> str:
    """What `Episodes.solved` takes for a success in `env`."""
    return getattr(env, "success", "unpunished")


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

    def epsilon_greedy(now: NDArray, u: NDArray, alive: NDArray) -> NDArray:
        act = uniform(env.n_actions, u[..., 1])
        exploit = alive & (u[..., 0] >= epsilon)
        if exploit.any():  # Q may be dear: ask it only where it decides
            asked = [x[lanes] for x, lanes in zip(now, exploit, strict=True)]
            values = np.concatenate(q(asked, env.n_actions))
            act[exploit] = greedy(values, u[..., 1][exploit])
        return act

    return play(env, epsilon_greedy, start, u)


def play(
    env: Env, policy: Policy, start: NDArray[np.float64], u: NDArray[np.float64]
) -> Episodes:
    """Episodes from start (S, E, d); the last of u (S, T, E, …) are the env's noise."""
    n_seeds, n_episodes, _ = start.shape
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
    return Episodes(*by_lane, length, start)


@functools.lru_cache(maxsize=64)
def transition_tables(
    env: Env,
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.bool_]]:
    """Next row, reward and absorption of a finite deterministic env, each (N, A)."""
    states = env.states()
    every = np.repeat(states[:, None], env.n_actions, axis=1)
    actions = np.broadcast_to(np.arange(env.n_actions), every.shape[:2])
    after, reward, absorbing = env.step(every, actions)
    return env.index(after), reward, absorbing


def _tabular_rollout(
    env: Env, q: Table, start: NDArray, u: NDArray, epsilon: float
) -> Episodes:
    """`rollout` on a finite environment, walked row by row in compiled code."""
    tables = transition_tables(env)
    first = env.index(start)
    walked = [
        _walk(*tables, values, first[s], u[s], epsilon)
        for s, values in enumerate(q.values)
    ]
    row, action, length = (np.stack(part) for part in zip(*walked, strict=True))
    void = np.arange(u.shape[1]) >= length[..., None]
    _, reward, absorbing = (table[row[..., :-1], action] for table in tables)
    reward[void], absorbing[void] = 0.0, False
    return Episodes(env.states()[row], action, reward, absorbing, length, start)


@kept(nogil=True)
def _walk(next_row, reward, absorbing, q, first, u, epsilon):
    """Rows (E, T + 1), actions (E, T) and lengths (E,) of one seed's episodes."""
    horizon, episodes = u.shape[0], u.shape[1]
    n_actions = q.shape[1]
    row = np.empty((episodes, horizon + 1), np.intp)
    action = np.zeros((episodes, horizon), np.intp)
    length = np.zeros(episodes, np.intp)
    for e in range(episodes):
        at = first[e]
        row[e, 0] = at
        for t in range(horizon):
            if u[t, e, 0] < epsilon:
                act = int(u[t, e, 1] * n_actions)
            else:  # as policies.greedy, whose code a cache of this file can't follow
                best, ties = q[at, 0], 1
                for a in range(1, n_actions):
                    if q[at, a] > best:
                        best, ties = q[at, a], 1
                    elif q[at, a] == best:
                        ties += 1
                rank = int(u[t, e, 1] * ties)
                act = -1
                while rank >= 0:
                    act += 1
                    if q[at, act] == best:
                        rank -= 1
            action[e, t] = act
            length[e] = t + 1
            done = absorbing[at, act]
            at = next_row[at, act]
            row[e, t + 1] = at
            if done:
                break
        row[e, length[e] + 1 :] = at
    return row, action, length
