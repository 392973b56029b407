"""A plain DQN in JAX, many seeds at once, for bench/peer_dqn.py.

It has the sizes, losses and schedule of `bcrl.learning.dqn.DQN`. All steps are one
`scan`; the seeds are one more axis (`vmap`). The step's number is common to all seeds,
so that copying the target network is a real branch.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from gymnax.environments import environment, spaces

from bcrl.envs.linear_system import (
    _GOAL_RADIUS,
    _START,
    ACTIONS,
    DT,
    NOISE,
    PATHWAY,
    WALLS,
    LinearSystem,
)
from bcrl.learning.dqn import DQN

ADAM = optax.adam(DQN.learning_rate)
GAMMA = 0.99


@struct.dataclass
class Params(environment.EnvParams):
    max_steps_in_episode: int = LinearSystem.horizon


@struct.dataclass
class State(environment.EnvState):
    at: jax.Array  # (x, ẋ, y, ẏ)


class JaxLinearSystem(environment.Environment):
    """Our linear system's target task behind gymnax's interface, one lane."""

    num_actions = len(ACTIONS)

    @property
    def default_params(self) -> Params:
        return Params()

    def reset_env(self, key: jax.Array, params: Params) -> tuple[jax.Array, State]:
        spread = jnp.array(LinearSystem().constants[2])
        at = jnp.array(_START) + spread * jax.random.uniform(key, (4,), minval=-1.0)
        return at, State(at=at, time=0)

    def step_env(self, key: jax.Array, state: State, action: Any, params: Params):
        task = LinearSystem()
        (gain, friction, _), (low, high) = task.constants, WALLS
        noise_key, start_key = jax.random.split(key)
        s, force = state.at, jnp.array(ACTIONS, jnp.float32)[action]
        drift = jnp.array([s[1] + task.drift, 0.0, s[3], 0.0])
        slope = drift.at[1::2].set(gain * force - friction * s[1::2])
        new = s + DT * (slope + NOISE * jax.random.normal(noise_key, (4,)))
        outside = (new[0] < low) | (new[0] > high)
        span = jnp.where(new[0] == s[0], 1.0, new[0] - s[0])
        wall = jnp.where(new[0] < low, low, high)
        share = jnp.clip((wall - s[0]) / span, 0.0, 1.0)
        rest = (1.0 - share) * DT
        there = (s + share * (new - s)) * jnp.array([1.0, -1.0, 1.0, 1.0])
        bounced = there + rest * jnp.array(
            [there[1], -friction * there[1], there[3], -friction * there[3]]
        )
        new = jnp.where(outside, bounced, new)
        fresh, _ = self.reset_env(start_key, params)
        new = jnp.where(jnp.abs(new[2]) > PATHWAY, fresh, new)
        arrived = new[0] ** 2 + new[2] ** 2 < _GOAL_RADIUS**2
        time = state.time + 1
        over = arrived | (time >= params.max_steps_in_episode)
        reward = jnp.where(arrived, 0.0, -1.0)
        return new, State(at=new, time=time), reward, over, {"discount": 1.0 - arrived}

    def action_space(self, params: Any = None) -> spaces.Discrete:
        return spaces.Discrete(self.num_actions)

    def observation_space(self, params: Any) -> spaces.Box:
        return spaces.Box(-jnp.inf, jnp.inf, (4,), jnp.float32)


def network(weights: list, x: jax.Array) -> jax.Array:
    for w, b in weights[:-1]:
        x = jax.nn.relu(x @ w + b)
    w, b = weights[-1]
    return x @ w + b


def begin(env: Any, params: Any, key: jax.Array) -> dict[str, Any]:
    """A seed's state before its first step."""
    env_key, key, *keys = jax.random.split(key, 5)
    seen, state = env.reset_env(env_key, params)
    sizes = (seen.size, *DQN.hidden, env.num_actions)
    draw, weights = jax.nn.initializers.xavier_uniform(), []
    for k, n_in, n_out in zip(keys, sizes, sizes[1:], strict=False):
        weights.append((draw(k, (n_in, n_out)), jnp.zeros(n_out)))
    rows = jnp.zeros((DQN.replay_size, 2 * seen.size + 3))  # s, s', r, discount, a
    now = {"online": weights, "target": weights, "adam": ADAM.init(weights)}
    return now | {"replay": rows, "seen": seen, "state": state, "key": key}


def step(env: Any, params: Any, now: dict[str, Any], number: jax.Array) -> dict:
    """Step `number` of one seed: act, store, update once the replay holds enough."""
    key, explore, random, env_key, reset, batch = jax.random.split(now["key"], 6)
    greedy = network(now["online"], now["seen"]).argmax()
    anything = jax.random.randint(random, (), 0, env.num_actions)
    epsilon = jnp.where(number < DQN.random_steps, 1.0, DQN.epsilon)
    action = jnp.where(jax.random.uniform(explore) < epsilon, anything, greedy)
    after, state, reward, over, info = env.step_env(
        env_key, now["state"], action, params
    )
    fixed = jnp.stack([reward, GAMMA * info["discount"], action])
    row = jnp.concatenate([now["seen"], after, fixed])
    rows = now["replay"].at[number % DQN.replay_size].set(row)
    fresh = env.reset_env(reset, params)
    seen, state = jax.tree.map(partial(jnp.where, over), fresh, (after, state))

    d, held = after.size, jnp.minimum(number + 1, DQN.replay_size)
    drawn = rows[jax.random.randint(batch, (DQN.batch_size,), 0, held)]
    at = d, 2 * d, 2 * d + 1, 2 * d + 2
    x, next_x, reward, discount, chosen = jnp.split(drawn, at, -1)
    best = network(now["target"], next_x).max(-1, keepdims=True)
    goal = reward + discount * best

    def loss(weights: list) -> jax.Array:
        value = jnp.take_along_axis(network(weights, x), chosen.astype(int), -1)
        return optax.huber_loss(value, goal).mean()

    def learn(weights: list, adam: Any) -> tuple:
        change, adam = ADAM.update(jax.grad(loss)(weights), adam)
        return optax.apply_updates(weights, change), adam

    networks = now["online"], now["adam"]
    ready = number >= DQN.learning_starts
    online, adam = jax.lax.cond(ready, learn, lambda *same: same, *networks)
    copy = (number + 1) % DQN.target_update == 0
    target = jax.lax.cond(copy, lambda: online, lambda: now["target"])
    now = {"online": online, "target": target, "adam": adam, "replay": rows}
    return now | {"seen": seen, "state": state, "key": key}


def running(one: Callable, states: Any, steps: int) -> Callable[[], None]:
    """Calls of `steps` more steps of all seeds; `one` is a step (states, number)."""

    @partial(jax.jit, donate_argnums=0)
    def many(states: Any, first: jax.Array) -> Any:
        numbers = first + jnp.arange(steps)
        return jax.lax.scan(lambda s, n: (one(s, n), None), states, numbers)[0]

    states, done = jax.tree.map(jnp.copy, states), 0  # shared parts can't be donated

    def call() -> None:
        nonlocal states, done
        states = jax.block_until_ready(many(states, jnp.int32(done)))
        done += steps

    return call


def agents(env: Any, params: Any, seeds: int, steps: int) -> Callable[[], None]:
    """The plain agent, `seeds` at once."""
    keys = jax.random.split(jax.random.key(0), seeds)
    states = jax.vmap(partial(begin, env, params))(keys)
    one = jax.vmap(partial(step, env, params), in_axes=(0, None))
    return running(one, states, steps)
