"""The engine computes the same numbers as the two minimal examples."""

import importlib.util
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from sklearn.ensemble import ExtraTreesRegressor
from threadpoolctl import threadpool_limits

from bcrl import api
from bcrl.common.seeding import stream
from bcrl.learning.stage import SeedBatch, learn
from tests.q.test_mlp import module

EXAMPLES = Path(__file__).parents[2] / "examples"
SEED = 3
BLOCK = 500  # steps whose draws come from one of the engine's streams


def example(name):
    """The module of an example; its table is not printed."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


fqi, dqn = example("minimal_bc_fqi"), example("minimal_sbc_dqn")


def engine(tasks, *rest):
    """The engine's snapshots of `stages(tasks, *rest)` for one seed."""
    return learn(
        api.stages(tasks, *rest), SeedBatch((SEED,), tasks[0].evaluation_states())
    )


@pytest.mark.parametrize("example", [fqi, dqn])
def test_an_example_is_short_and_needs_no_engine(example):
    text = Path(example.__file__).read_text()
    assert len(text.splitlines()) <= 120
    assert "bcrl" not in text


# --- BC-FQI ---


@pytest.mark.parametrize("masses", [(0.8, 1.0, 1.2), (1.2,)], ids=["BC-FQI", "FQI"])
def test_fitted_q_iteration_is_the_engines(masses):
    """With the same data and forests, Q is the same in every stage."""
    trees, iterations = 5, 3
    forest = ExtraTreesRegressor(trees, min_samples_split=5, min_samples_leaf=2)
    learner = api.FQI(iterations=iterations, episodes=20, regressor=api.Sklearn(forest))
    tasks = [api.CarOnHill(mass=mass) for mass in masses]
    boost = [api.Boost()] * (len(tasks) > 1)
    ends = [now for now in engine(tasks, learner, *boost) if now.last_of_stage]

    datasets = [
        (d.points[d.state], d.action, d.reward, d.points[d.next_state], d.absorbing)
        for d in (now.result.data[0] for now in ends)
    ]
    paths = product(range(1, len(tasks) + 1), range(1, iterations + 1), range(2))
    draws = (stream(SEED, "trees", *path) for path in paths)
    rng = SimpleNamespace(integers=lambda high: int(next(draws).integers(high)))
    residuals = fqi.bc_fqi(datasets, iterations, rng, trees)

    states = np.random.default_rng(0).uniform((-1, -3), (1, 3), (500, 2))
    for number, now in enumerate(ends, start=1):
        (expected,) = now.result.q([states], 2)
        assert abs(expected).max() > 0.1
        found = fqi.q_values(residuals[:number], states)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("mass", fqi.MASSES)
def test_the_car_is_the_engines(mass):
    """The midpoint rule errs by 0.001, and by more where the hill's curvature jumps."""
    rng = np.random.default_rng(1)
    states, action = rng.uniform((-1, -3), (1, 3), (500, 2)), rng.integers(2, size=500)
    after, *others = fqi.step(mass, states, action)
    expected, *expected_others = api.CarOnHill(mass=mass).step(states, action)
    error = abs(after - expected).max(axis=1)
    crosses = (states[:, 0] < 0) != (expected[:, 0] < 0)
    assert error.max() < 0.05 and error[~crosses].max() < 1e-3
    edges = np.array([[1.0, 3.0], [-1.0, -3.0]])
    clear = (abs(expected[:, None] - edges) > 0.05).all((1, 2))
    assert clear.mean() > 0.8
    for found, other in zip(others, expected_others, strict=True):
        assert np.array_equal(found[clear], other[clear])


# --- SBC-DQN ---


class Pathway(api.LinearSystem):
    """The engine's target task with the example's dynamics, which have no noise."""

    def initial(self, noise):
        return dqn.start(noise)

    def step(self, state, action, noise):
        return dqn.step(state, action, dqn.start(noise[:, 4:]))


class EngineDraws:
    """Stands in for the example's generator and gives the engine's draws of stage 2.

    A step's uniforms are: does it explore, which action, the prior's action (not in
    use), four of noise (not in use), a fresh start, the next episode's start.
    """

    def __init__(self, steps):
        self.steps = self._rows("exploration", 15, steps)
        self.batches = self._rows("replay", dqn.BATCH, steps)
        self.starts = [stream(SEED, "exploration", 2).random((1, 4))]

    def _rows(self, purpose, width, steps):
        for t in range(steps):
            if t % BLOCK == 0:
                block = stream(SEED, purpose, 2, t // BLOCK).random((BLOCK, width))
            yield block[t % BLOCK]

    def random(self, shape=None):
        if shape:
            return self.starts.pop(0)
        explore, self.choice, *_ = u = next(self.steps)
        self.batch, self.starts = next(self.batches), [u[None, 7:11], u[None, 11:]]
        return explore

    def integers(self, high, size):
        u = self.batch if size == dqn.BATCH else np.array([self.choice])
        return (u * high).astype(int)


@pytest.fixture(scope="module")
def trained():
    """SBC-DQN by the engine: base matrix, losses, first and last network."""
    settings = api.DQN(steps=800, target_update=100, evaluate_every=50)
    tasks = [api.LinearSystem("lq", horizon=100), Pathway()]
    moments = engine(tasks, [api.LSPI(), settings], api.Boost(), api.Shape())
    base = next(now for now in moments if now.last_of_stage).result.q.matrix[0]
    first, losses = module(next(moments).result.residual.online, 0), []
    for now in moments:
        losses.append(now.loss[0])
    return base, losses, first, module(now.result.residual.online, 0)


def test_deep_q_learning_is_the_engines(trained):
    """With the same draws, 300 updates differ by float32 rounding only.

    Measured: losses by 3e-7 of their size, ϱ by 7e-6 where it is about 4.
    """
    base, losses, network, last = trained
    states = dqn.start(np.random.default_rng(0).random((100, 4)))
    before, expected = (dqn.terms(net, base, states)[1] for net in (network, last))
    with threadpool_limits(1):
        found = list(dqn.sbc_dqn(network, base, EngineDraws(800), 800, 100))
    assert np.isnan(found[:500]).all() and np.isnan(losses[:10]).all()
    means = np.reshape(found[500:], (6, 50)).mean(axis=1)
    np.testing.assert_allclose(means, losses[10:], rtol=1e-4)
    after = dqn.terms(network, base, states)[1]
    np.testing.assert_allclose(after, expected, rtol=0, atol=1e-3)
    assert abs(after - before).min() > 0.1


def test_least_squares_policy_iteration_finds_the_engines_base(trained):
    """LSPI's Q does not depend on the draws but for the engine's noise: 0.1 %."""
    base, *_ = trained
    found = dqn.lspi(np.random.default_rng(0))
    np.testing.assert_allclose(found, base, rtol=0, atol=1e-3 * abs(base).max())


def test_the_pathway_is_the_engines():
    """Away from the walls the step is the engine's without noise."""
    rng = np.random.default_rng(2)
    low, high = [-4.9, -1.0, -0.6, -1.0], [0.9, 1.0, 0.6, 1.0]
    states, action = rng.uniform(low, high, (2000, 4)), rng.integers(8, size=2000)
    noise = np.hstack([np.full((2000, 4), 0.5), rng.random((2000, 4))])
    found = dqn.step(states, action, dqn.start(noise[:, 4:]))
    expected = api.LinearSystem().step(states, action, noise)
    assert found[2].any()
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)
