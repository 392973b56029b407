"""MushroomRL's FQI and DQN against ours, same sizes, on one core: make bench-peer

Needs MushroomRL 1.10.2 in the environment. FQI: one iteration, after a few others, on
1000 random episodes of *its* car on the hill (1 kg) by its agent with scikit-learn's
extra-trees (50 trees, as in the paper), and of our car by our learner. DQN: one step
with its update, of its agent with the paper's network, batch and replay on *our* linear
system, and of 1 and 20 of our seeds in lockstep. Both take turns; the least CPU time of
several counts.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from dqn import STEPS, lockstep, perceptron
from mushroom_rl.algorithms.value.batch_td.fqi import FQI as TheirFQI
from mushroom_rl.algorithms.value.dqn.dqn import DQN as TheirDQN
from mushroom_rl.approximators.parametric import TorchApproximator
from mushroom_rl.core import Core, Environment, MDPInfo
from mushroom_rl.environments.car_on_hill import CarOnHill as TheirCar
from mushroom_rl.policy import EpsGreedy
from mushroom_rl.utils import spaces
from mushroom_rl.utils.parameters import Parameter
from sklearn.ensemble import ExtraTreesRegressor
from threadpoolctl import threadpool_limits
from timing import by_turns

from bcrl.envs.car_on_hill import CarOnHill
from bcrl.envs.linear_system import LinearSystem
from bcrl.evaluation.metrics import probed_states
from bcrl.learning.fqi import FQI
from bcrl.learning.stage import SeedBatch, Stage, learn
from bcrl.q.regressors.ours import ForestRegressor

EPISODES, EARLY = 1000, 6


class Wrapped(Environment):
    """Our linear system behind their interface, one lane."""

    def __init__(self) -> None:
        self._env, self._rng = LinearSystem(), np.random.default_rng(0)
        box = spaces.Box(-np.inf, np.inf, shape=(4,))
        actions = spaces.Discrete(self._env.n_actions)
        super().__init__(MDPInfo(box, actions, self._env.gamma, self._env.horizon))

    def reset(self, state=None):
        self._state = self._env.initial(self._rng.random(4))
        return self._state

    def step(self, action):
        after, reward, absorbing = self._env.step(
            self._state, np.intp(action[0]), self._rng.random(8)
        )
        self._state = after
        return after, float(reward), bool(absorbing), {}


class Network(torch.nn.Module):
    """Two hidden layers of 128, as their approximator wants it."""

    def __init__(self, input_shape, output_shape, **_) -> None:
        super().__init__()
        self.layers = perceptron(input_shape[0], output_shape[0])

    def forward(self, state, action=None):
        values = self.layers(state.float())
        if action is None:
            return values
        return values.gather(1, action.long()).squeeze(1)


def their_fqi() -> Callable[[], object]:
    """An iteration at each call."""
    car = TheirCar()
    agent = TheirFQI(
        car.info,
        EpsGreedy(Parameter(1.0)),
        ExtraTreesRegressor,
        n_iterations=1,
        quiet=True,
        approximator_params={
            "input_shape": car.info.observation_space.shape,
            "n_actions": 2,
            "n_estimators": 50,
            "min_samples_split": 5,
            "min_samples_leaf": 2,
            "n_jobs": 1,
        },
    )
    episodes = Core(agent, car).evaluate(n_episodes=EPISODES, quiet=True)
    print(f"MushroomRL's dataset: {len(episodes)} transitions")
    return lambda: agent.fit(episodes)


def our_fqi() -> Callable[[], object]:
    env = CarOnHill(mass=1.0)
    stage = Stage(1, 1, env, FQI(10**9, EPISODES, ForestRegressor()), (), 0)
    run = learn([stage], SeedBatch((0,), probed_states(env)))
    (data,) = next(run).result.data
    print(f"our dataset: {int(data.multiplicity.sum())} transitions")
    return lambda: next(run)


def their_dqn() -> Callable[[], object]:
    env = Wrapped()
    agent = TheirDQN(
        env.info,
        EpsGreedy(Parameter(0.1)),
        TorchApproximator,
        approximator_params={
            "network": Network,
            "optimizer": {"class": torch.optim.Adam, "params": {"lr": 1e-4}},
            "loss": torch.nn.functional.smooth_l1_loss,
            "input_shape": env.info.observation_space.shape,
            "output_shape": (env.info.action_space.n,),
            "n_actions": env.info.action_space.n,
        },
        batch_size=32,
        target_update_frequency=200,
        initial_replay_size=500,
        max_replay_size=10_000,
    )
    core = Core(agent, env)
    core.learn(n_steps=600, n_steps_per_fit=1, quiet=True)
    return lambda: core.learn(n_steps=STEPS, n_steps_per_fit=1, quiet=True)


def our_dqn(seeds: int) -> Callable[[], object]:
    run = lockstep(seeds)
    next(run), next(run)  # filled, compiled, updating
    return lambda: next(run)


def main() -> None:
    torch.set_num_threads(1)
    with threadpool_limits(1):
        calls = [their_fqi(), our_fqi()]
        by_turns(calls, EARLY)
        theirs, ours = by_turns(calls, 3)
        steps = [their_dqn(), our_dqn(1), our_dqn(20)]
        their_step, alone, together = by_turns(steps, 3)
    print(f"\n{'one core':42}{'MushroomRL':>12}{'ours':>10}{'ratio':>8}")
    head = "FQI iteration, car on the hill, ms"
    print(f"{head:42}{theirs * 1e3:12.0f}{ours * 1e3:10.0f}{theirs / ours:7.1f}x")
    for name, took, seeds in (("1 seed", alone, 1), ("20 seeds", together, 20)):
        a, b = their_step / STEPS * 1e6, took / STEPS / seeds * 1e6
        head = f"DQN step, {name}, us a seed and step"
        print(f"{head:42}{a:12.0f}{b:10.0f}{a / b:7.1f}x")


if __name__ == "__main__":
    main()
