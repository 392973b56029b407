"""Our DQN in seed lockstep against other agents, one core: make bench-peers

All have the paper's network, batch, replay, ε and target updates (`DQN`'s defaults) and
make one update per step. Stable-Baselines3 and MushroomRL learn one seed. The JAX
agents learn many: a plain one (jax_dqn.py) and rejax, whose evaluations and compilation
are left out; they use gymnax's environments, ours and the others Gymnasium's. All take
turns; the least CPU time of several calls counts, per seed and environment step.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import gymnasium
import gymnax
import jax
import numpy as np
import torch
from dqn import lockstep, perceptron
from flax import linen
from jax_dqn import JaxLinearSystem, Params, agents, running
from mushroom_rl.algorithms.value.dqn.dqn import DQN as MushroomDQN
from mushroom_rl.approximators.parametric import TorchApproximator
from mushroom_rl.core import Core, Environment, MDPInfo
from mushroom_rl.policy import EpsGreedy
from mushroom_rl.utils import spaces
from mushroom_rl.utils.parameters import Parameter
from rejax import get_algo
from rejax.networks import DiscreteQNetwork, EpsilonGreedyPolicy
from stable_baselines3 import DQN as StableDQN
from threadpoolctl import threadpool_limits
from timing import by_turns, one_core

from bcrl.envs.gym_api import GymEnv
from bcrl.envs.gymnasium import Gymnasium
from bcrl.envs.linear_system import LinearSystem
from bcrl.learning.dqn import DQN

LINEAR, TURNS = "linear system", 3
#: Number of seeds → steps per call, multiples of the steps between target updates
STEPS = {1: 600, 20: 400, 100: 200}
WARM_UP = 3  # calls that compile and end with updates
#: Task → numbers of seeds that learn at once
TASKS = {LINEAR: (20, 100), "CartPole-v1": (20,)}
TASKS |= {"MountainCar-v0": (20,), "Acrobot-v1": (20,)}
IN_JAX = (LINEAR, "CartPole-v1")  # a compilation takes longer than the rest
NAMES = ("bcrl", "Stable-Baselines3", "MushroomRL", "JAX", "rejax")
GAMMA = LinearSystem.gamma

Call = Callable[[], object]


def ours(task: str, seeds: int) -> Call:
    env = LinearSystem() if task == LINEAR else Gymnasium(task)
    run = lockstep(seeds, env, STEPS[seeds])
    return lambda: next(run)


def simulator(task: str) -> gymnasium.Env:
    if task != LINEAR:
        return gymnasium.make(task)
    return gymnasium.wrappers.TimeLimit(GymEnv(LinearSystem()), LinearSystem.horizon)


def stable_baselines(task: str) -> Call:
    agent = StableDQN(
        "MlpPolicy",
        simulator(task),
        learning_rate=DQN.learning_rate,
        buffer_size=DQN.replay_size,
        learning_starts=DQN.learning_starts,
        batch_size=DQN.batch_size,
        gamma=GAMMA,
        train_freq=1,
        target_update_interval=DQN.target_update,
        exploration_initial_eps=DQN.epsilon,
        exploration_final_eps=DQN.epsilon,
        policy_kwargs={"net_arch": list(DQN.hidden)},
        device="cpu",
        seed=0,
    )
    more = partial(agent.learn, STEPS[1], log_interval=10**9)
    return lambda: more(reset_num_timesteps=False)


class Wrapped(Environment):
    """A Gymnasium environment behind MushroomRL's interface."""

    def __init__(self, env: gymnasium.Env) -> None:
        self._env = env
        box = spaces.Box(-np.inf, np.inf, shape=env.observation_space.shape)
        actions = spaces.Discrete(int(env.action_space.n))
        steps = env.spec.max_episode_steps if env.spec else LinearSystem.horizon
        super().__init__(MDPInfo(box, actions, GAMMA, steps))

    def reset(self, state=None):
        return self._env.reset()[0]

    def step(self, action):
        after, reward, ended, _, _ = self._env.step(int(action[0]))
        return after, float(reward), bool(ended), {}


class Network(torch.nn.Module):
    """Two hidden layers of 128, as MushroomRL's approximator wants it."""

    def __init__(self, input_shape, output_shape, **_) -> None:
        super().__init__()
        self.layers = perceptron(input_shape[0], output_shape[0])

    def forward(self, state, action=None):
        values = self.layers(state.float())
        if action is None:
            return values
        return values.gather(1, action.long()).squeeze(1)


def mushroom(task: str) -> Call:
    env = Wrapped(simulator(task))
    actions = env.info.action_space.n
    agent = MushroomDQN(
        env.info,
        EpsGreedy(Parameter(DQN.epsilon)),
        TorchApproximator,
        approximator_params={
            "network": Network,
            "optimizer": {
                "class": torch.optim.Adam,
                "params": {"lr": DQN.learning_rate},
            },
            "loss": torch.nn.functional.smooth_l1_loss,
            "input_shape": env.info.observation_space.shape,
            "output_shape": (actions,),
            "n_actions": actions,
        },
        batch_size=DQN.batch_size,
        target_update_frequency=DQN.target_update,
        initial_replay_size=DQN.learning_starts,
        max_replay_size=DQN.replay_size,
    )
    core = Core(agent, env)
    return lambda: core.learn(n_steps=STEPS[1], n_steps_per_fit=1, quiet=True)


def jax_task(task: str) -> tuple:
    return (JaxLinearSystem(), Params()) if task == LINEAR else gymnax.make(task)


def plain_jax(task: str, seeds: int) -> Call:
    return agents(*jax_task(task), seeds, STEPS[seeds])


def rejax(task: str, seeds: int) -> Call:
    env, params = jax_task(task)
    algorithm = get_algo("dqn").create(
        env=env,
        env_params=params,
        learning_rate=DQN.learning_rate,
        gamma=GAMMA,
        buffer_size=DQN.replay_size,
        fill_buffer=DQN.learning_starts,
        batch_size=DQN.batch_size,
        target_update_freq=DQN.target_update,
        polyak=0.0,
        eps_start=DQN.epsilon,
        eps_end=DQN.epsilon,
        ddqn=False,
    )
    policy = EpsilonGreedyPolicy(DiscreteQNetwork)  # its default network has 64, 64
    algorithm = algorithm.replace(
        agent=policy(
            hidden_layer_sizes=DQN.hidden,
            action_dim=env.num_actions,
            activation=linen.relu,
        )
    )
    states = jax.vmap(algorithm.init_state)(jax.random.split(jax.random.key(0), seeds))
    one = jax.vmap(lambda state, _: algorithm.train_iteration(state), in_axes=(0, None))
    return running(one, states, STEPS[seeds])


def compare(task: str, sizes: tuple[int, ...]) -> None:
    """Print the rows of a task."""
    calls = {("Stable-Baselines3", 1): stable_baselines(task)}
    calls["MushroomRL", 1] = mushroom(task)
    for seeds in sizes if task in IN_JAX else ():
        calls["JAX", seeds] = plain_jax(task, seeds)
    if task in IN_JAX:
        calls["rejax", 20] = rejax(task, 20)
    for seeds in (1, *sizes):
        calls["bcrl", seeds] = ours(task, seeds)
    by_turns([*calls.values()], WARM_UP)
    times = dict(zip(calls, by_turns([*calls.values()], TURNS), strict=True))
    each = {key: 1e6 * t / STEPS[key[1]] / key[1] for key, t in times.items()}
    for seeds in (1, *sizes):
        cells = [task, f"{seeds}", f"{each['bcrl', seeds]:.0f} µs"]
        for name in NAMES[1:]:
            took = each.get((name, seeds), each.get((name, 1)))
            ratio = took and f"{took:.0f} µs, {took / each['bcrl', seeds]:.1f}×"
            cells.append(ratio or "")
        print("| " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    one_core()
    torch.set_num_threads(1)
    head = ("task", "seeds", *NAMES)
    print("| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|", flush=True)
    with threadpool_limits(1):
        for task, sizes in TASKS.items():
            compare(task, sizes)


if __name__ == "__main__":
    main()
