"""Agents take one observation or several, of any kind that environments give."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, Tuple

from bcrl.api import CarOnHill, Gymnasium
from bcrl.errors import BcrlError
from bcrl.learning.agent import Agent, Residual
from bcrl.learning.learned import Learned
from bcrl.learning.transfer import StageResult


class Odd(gymnasium.Env):
    """Observes a dict with a number and an array; its second action ends it."""

    def __init__(self, render_mode=None):
        self.observation_space = Dict(at=Discrete(5), more=Tuple([Box(-1, 1, (2,))]))
        self.action_space = Discrete(2)

    def reset(self, *, seed=None, options=None):
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, bool(action), False, {}


gymnasium.register("tests/Odd-v0", Odd)


def agent_of(task):
    """An agent of a task with a linear Q."""
    weights = np.random.default_rng(0).normal(size=(task.state_dim, task.n_actions))

    def q(states, n_actions):
        return states @ weights

    return Agent(task, {"long": "text" * 1000}, 3, Learned(StageResult(q, q), (q,)))


@pytest.mark.parametrize("name", ["Blackjack-v1", "tests/Odd-v0", "CartPole-v1"])
def test_observations_of_a_vector_environment_and_lists_of_them(name):
    agent = agent_of(Gymnasium(id=name, horizon=5))
    envs = gymnasium.vector.SyncVectorEnv([lambda: gymnasium.make(name)] * 3)
    together, _ = envs.reset(seed=[4, 5, 6])
    each = [gymnasium.make(name).reset(seed=seed)[0] for seed in (4, 5, 6)]
    actions = [agent.act(one) for one in each]
    assert all(type(action) is int for action in actions)
    values = np.concatenate([agent.q(one) for one in each])
    assert values.shape == (3, agent.task.n_actions)
    for several in (together, each, tuple(each)):
        assert agent.act(several).tolist() == actions
        assert np.allclose(agent.q(several), values)
    for wrong in (None, 0.5, "text", [None], {"at": 1}, (1, 2, 3, 4, 5)):
        for call in (agent.act, agent.q):
            with pytest.raises(BcrlError):
                call(wrong)
    assert agent.act([]).shape == (0,)


def test_vectors_are_taken_one_by_one_or_in_rows():
    agent = agent_of(CarOnHill())
    assert agent.act(np.empty((0, 2))).shape == (0,)
    assert agent.q(np.empty((0, 2))).shape == (0, 2)
    assert agent.q([0.1, 0.2]).tolist() == agent.q([[0.1, 0.2]]).tolist()
    for wrong in (None, 0.5, [0.1], np.zeros((2, 3)), [[0.1], [0.1, 0.2]], "no"):
        for call in (agent.act, agent.q):
            with pytest.raises(BcrlError, match="car_on_hill"):
                call(wrong)


def test_agents_are_compared_by_identity_and_shown_in_one_line():
    agent, other = agent_of(CarOnHill()), agent_of(CarOnHill())
    assert agent != other and len({agent, other, Residual(agent, agent.q)}) == 3
    for thing in (agent, *agent.residuals):
        assert len(repr(thing)) < 80 and "car_on_hill" in repr(thing)
