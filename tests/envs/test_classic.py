"""Classic control in compiled code, against Gymnasium's own simulators."""

from multiprocessing import Pipe

import numpy as np
import pytest

from bcrl.api import Gymnasium
from bcrl.envs import classic
from bcrl.envs.compiled_lanes import CompiledLanes, sines_differ
from bcrl.envs.simulators import SimulatedLanes
from bcrl.run import runner
from tests.conftest import plan

exact = pytest.mark.skipif(sines_differ(), reason="NumPy's sines are its own here")
BINS = {"name": "DiscretizeAction", "bins": 5}
RESCALED = {"name": "RescaleObservation", "min_obs": -1.0, "max_obs": 1.0}
PENDULUM = {"success": "survived", "horizon": 100, "wrappers": [BINS]}
STRONG = {"AVAIL_TORQUE": [-5.0, 0, 5], "LINK_MASS_1": 1.3, "MAX_VEL_1": 9.0}
LIGHT = {"masspole": 0.3, "length": 0.7, "gravity": 4.0, "theta_threshold_radians": 1}
CASES = [
    ("CartPole-v1", {}),
    ("CartPole-v0", {"attributes": LIGHT | {"kinematics_integrator": "semi"}}),
    ("CartPole-v1", {"kwargs": {"sutton_barto_reward": True}, "success": "survived"}),
    ("MountainCar-v0", {}),
    ("MountainCar-v0", {"kwargs": {"goal_velocity": 0.02}, "wrappers": [RESCALED]}),
    ("MountainCar-v0", {"attributes": {"force": 0.01, "max_speed": 0.05}}),
    ("Acrobot-v1", {"horizon": 200}),
    ("Acrobot-v1", {"horizon": 100, "attributes": STRONG | {"book_or_nips": "nips"}}),
    ("Pendulum-v1", PENDULUM),
    ("Pendulum-v1", PENDULUM | {"wrappers": [RESCALED, BINS], "kwargs": {"g": 3}}),
    ("Pendulum-v1", PENDULUM | {"attributes": {"m": 1.7, "max_torque": 1, "dt": 0.1}}),
]


@exact
@pytest.mark.parametrize(("name", "changes"), CASES)
def test_every_bit_is_that_of_gymnasium(name, changes):
    here, there = Pipe()  # as to a worker process
    with here, there:
        here.send(Gymnasium(name, **changes))
        task, rng = there.recv(), np.random.default_rng(0)
    lanes, own = task.lanes(), SimulatedLanes(task)
    assert isinstance(lanes, CompiledLanes)
    start = rng.random((2, 8, 1))
    state = lanes.begin(start)
    assert state.tobytes() == own.begin(start).tobytes()
    ended = 0
    for _ in range(150):
        lively = rng.random((2, 8)) < 0.9
        action = rng.integers(task.n_actions, size=lively.sum())
        found, known = (x.step(None, action, None, (lively,)) for x in (lanes, own))
        for a, b in zip(found[:3], known[:3], strict=True):
            assert (a.dtype, a.tobytes()) == (b.dtype, b.tobytes())
        hidden = [np.array(each.env.unwrapped.state, float) for each in own.simulators]
        assert lanes.hidden.tobytes() == np.array(hidden).tobytes()
        over, start = rng.random((2, 8)) < 0.01, rng.random((2, 8, 1))
        over[lively] |= found[2]
        state[lively] = found[0]
        ended += found[2].sum()
        again = own.restart(over, start, state)
        state = lanes.restart(over, start, state)
        assert state.tobytes() == again.tobytes()
    assert ended or name == "Pendulum-v1" or "attributes" not in changes


@pytest.mark.parametrize(
    "changes",
    [
        {"wrappers": [{"name": "StickyAction", "repeat_action_probability": 0.5}]},
        {"wrappers": [{"name": "FrameStackObservation", "stack_size": 2}]},
        {"attributes": {"torque_noise_max": 0.5}},
        {"observation": "numpy.cbrt"},
    ],
)
def test_a_task_that_is_not_known_has_simulators(changes, monkeypatch):
    monkeypatch.setenv("BCRL_TRUST", "numpy")
    task = Gymnasium("Acrobot-v1", horizon=20, **changes)
    assert isinstance(task.lanes(), SimulatedLanes)


def test_another_step_of_gymnasium_is_noticed(monkeypatch):
    name, recipe = "cartpole.CartPoleEnv", {"attributes": {"tau": 0.019}}
    other = classic.PHYSICS["acrobot.AcrobotEnv"].observation
    changed = classic.PHYSICS[name]._replace(observation=other)
    monkeypatch.setitem(classic.PHYSICS, name, changed)
    task = Gymnasium("CartPole-v1", **recipe)
    assert isinstance(task.lanes(), SimulatedLanes)
    assert "not compiled" in task.trial.notes[-1]


def test_a_lane_with_numbers_beyond_float32_fails_alone():
    lanes = Gymnasium("CartPole-v1").lanes()
    state = lanes.begin(np.full((2, 2, 1), 0.5))
    lanes.hidden[0, 1] = 1e39
    for _ in range(2):
        state, reward, ended, cut = lanes.step(state, np.ones((2, 2), int), None)
        assert reward.tolist() == [[1.0, 0.0], [1.0, 1.0]] and not ended.any()
        assert cut.tolist() == [[False, True], [False, False]]
        state = lanes.restart(cut, np.full((2, 2, 1), 0.5), state)
        assert list(lanes.failures) == [1] and not state[0, 1].any()


SMALL = ("env=gymnasium", "scale=smoke", "progress=none", "seeds.count=2", "tag=t")
FQI = ("env.id=MountainCar-v0", "env.attributes={force: 0.01}", "env.starts=3")
FQI += ("algorithm.regressor.trees=3", "scale.max_iterations=2", "algorithm.epsilon=1")
DQN = ("env.id=CartPole-v1", "algorithm=dqn", "algorithm.steps=150")
DQN += ("algorithm.learning_starts=20", "algorithm.evaluation_episodes=3")


@exact
@pytest.mark.parametrize("own", [FQI, DQN], ids=["FQI", "DQN"])
def test_result_files_are_those_of_the_simulators(own, tmp_path, monkeypatch):
    found = []
    for lanes in (Gymnasium.lanes, SimulatedLanes):
        monkeypatch.setattr(Gymnasium, "lanes", lambda task, make=lanes: make(task))
        made = plan(*SMALL, *own, f"runs_dir={tmp_path}/{len(found)}")
        runner.run(made)
        found.append([p.read_bytes() for p in sorted(made.directory.glob("*.csv"))])
    assert len(found[0]) == 2 and found[0] == found[1]
