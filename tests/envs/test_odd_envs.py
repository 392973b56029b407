"""Odd environments are as good as the plain one, or rejected with one message."""

import gc
import json
import os
from pathlib import Path

import gymnasium
import numpy as np
import pandas as pd
import pytest

from bcrl.api import DQN, FQI, Forest, Gymnasium, run, stages
from bcrl.envs._recipe import Recipe
from bcrl.envs.simulators import Simulator
from bcrl.errors import BcrlError
from bcrl.learning.rollout import rollout
from bcrl.run import runner
from tests.conftest import plan, plans
from tests.envs import odd

SMALL = ("env=gymnasium", "scale=smoke", "progress=none", "seeds.count=1", "tag=t")
SMALL += ("env.starts=3", "env.success=absorbed")
FEW = ("algorithm.regressor.trees=3", "scale.max_iterations=2", "scale.max_episodes=4")
FEW += ("algorithm.epsilon=0.5",)
FEW_STEPS = ("algorithm=dqn", "algorithm.steps=40", "algorithm.random_steps=20")
FEW_STEPS += ("algorithm.learning_starts=20", "algorithm.evaluate_every=20")
FEW_STEPS += ("algorithm.evaluation_episodes=2",)
BY_EPISODES = FQI(2, 5, Forest(trees=3), epsilon=0.5)
BY_STEPS = DQN(40, 10, 10, evaluate_every=20, evaluation_episodes=2)


def results(name, learner=BY_EPISODES):
    """What two seeds learn in an odd environment."""
    task = Gymnasium(f"odd/{name}-v0", success="absorbed", starts=4)
    return run(stages([task], learner), [0, 1], progress=False)


@pytest.fixture(scope="module")
def plain():
    return results("Walk")


@pytest.mark.parametrize("name", [*odd.SAME, *(c.__name__ for c in odd.OWN)])
def test_adapted_answers_give_the_numbers_of_the_plain_walk(name, plain):
    pd.testing.assert_frame_equal(results(name), plain)


def test_dqn_takes_adapted_environments_too():
    plain, odd_one = (results(name, BY_STEPS) for name in ("Walk", "NoEarlyReset"))
    pd.testing.assert_frame_equal(odd_one, plain)


@pytest.mark.parametrize("name", odd.VECTORS)
def test_observations_become_vectors(name):
    task, twin = (Gymnasium(f"odd/{each}-v0") for each in (name, "Walk"))
    lanes, plain = task.lanes(), twin.lanes()
    start = np.random.default_rng(0).random((9, 1))
    state, at = lanes.begin(start), plain.begin(start)
    for _ in range(3):
        expected = [odd.VECTORS[name][0](int(x)) for x in at[:, 0]]
        np.testing.assert_array_equal(state, expected)
        action = np.arange(9) % 2
        state, at = (x.step(None, action, None)[0] for x in (lanes, plain))


@pytest.mark.parametrize("name", odd.REJECTED)
def test_a_broken_contract_is_named(name):
    with pytest.raises(BcrlError) as rejected:
        Gymnasium(f"odd/{name}-v0", success="absorbed")
    text = str(rejected.value)
    assert text.startswith(f"env.id=odd/{name}-v0: ") and "\n" not in text
    for part in odd.REJECTED[name][0].split(" … "):
        assert part in text


@pytest.mark.parametrize("name", ["OldStep", "LateDice"])
def test_a_command_rejects_it_before_any_work(name, tmp_path):
    given = (f"env.id=odd/{name}-v0", f"runs_dir={tmp_path}/runs")
    with pytest.raises(BcrlError) as rejected:
        plans(*SMALL, *given)
    assert rejected.value.exit_code == 2 and not (tmp_path / "runs").exists()


def held():
    """The number of files that the process holds for odd environments."""
    links = (Path("/proc/self/fd", number) for number in os.listdir("/proc/self/fd"))
    return sum("held" in os.path.realpath(link) for link in links)


counted = pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="counts files")


@counted
def test_no_file_stays_open():
    results("HoldsAFile", BY_STEPS)
    gc.collect()
    assert held() == 0
    lanes = Gymnasium("odd/HoldsAFile-v0").lanes()
    lanes.begin(np.full((3, 1), 0.5))
    assert held() == 3
    del lanes
    gc.collect()
    assert held() == 0


@counted
def test_few_simulators_exist_at_a_time_and_the_numbers_are_the_same(monkeypatch):
    task, rng = Gymnasium("odd/HoldsAFile-v0"), np.random.default_rng(0)
    start, u = rng.random((2, 11, 1)), rng.random((2, 12, 11, 2))
    most = []

    def q(states, n_actions):
        most.append(held())
        return [np.stack([x[:, 0] % 3, x[:, 0] % 2], -1) for x in states]

    whole = rollout(task, q, start, u, epsilon=0.3)
    assert max(most) == 22
    most.clear()
    monkeypatch.setattr("bcrl.learning.rollout.AT_ONCE", (1, 8))
    parts = rollout(task, q, start, u, epsilon=0.3)
    assert max(most) == 8 and held() == 0
    np.testing.assert_equal(vars(whole), vars(parts))


@pytest.mark.parametrize("own", [FEW, FEW_STEPS], ids=["FQI", "DQN"])
def test_a_simulator_that_fails_in_a_run_fails_its_seed_alone(own, tmp_path):
    asked = (*SMALL, *own, "env.id=odd/FailsLate-v0", "seeds.count=6")
    fine, doomed = (
        plan(*asked, f"env.kwargs={{doom: {doom}}}", f"runs_dir={tmp_path}/{doom}")
        for doom in (0, 1)
    )
    runner.run(fine)
    with pytest.raises(runner.SeedsFailed, match=r"env\.id=odd/FailsLate-v0") as lost:
        runner.run(doomed)
    assert "RuntimeError: the motor is stuck (…/odd.py:" in str(lost.value)
    seeds = sorted(doomed.directory.glob("seed_*.json"))
    whole = [s for s in seeds if json.loads(s.read_text())["status"] == "complete"]
    assert len(seeds) == 6 and 0 < len(whole) < 6
    for path in (each.with_suffix(".csv") for each in whole):
        assert path.read_bytes() == (fine.directory / path.name).read_bytes()


def test_success_in_info_has_to_be_true_or_false():
    known = ((1, True), (np.array([True]), True), (False, False))
    unknown = ((value, None) for value in ("no", None, 0.3, np.nan, {}))
    for value, expected in (*known, *unknown):
        simulator = Simulator(Recipe("odd/Walk-v0"))
        assert simulator._success("step", {"success": value}) is bool(expected)
        assert simulator.reports == (expected is not None)


def test_a_registered_threshold_of_zero_is_one():
    gymnasium.register("odd/Zero-v0", odd.Walk, 0.0, max_episode_steps=12)
    assert Gymnasium("odd/Zero-v0", success="threshold").success_threshold == 0.0
