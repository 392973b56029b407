"""Odd environments are as good as the plain one, or rejected with one message."""

import gc
import json
import os

import gymnasium
import numpy as np
import pandas as pd
import pytest
from gymnasium import spaces

from bcrl.api import DQN, FQI, Forest, Gymnasium, run, stages
from bcrl.config import jobs
from bcrl.envs import Success
from bcrl.envs._contract import Simulator
from bcrl.errors import BcrlError
from bcrl.learning.rollout import rollout
from bcrl.run import runner
from tests.conftest import arguments, plan
from tests.envs import odd

SMALL = ("env=gymnasium", "scale=smoke", "progress=none", "seeds.count=1", "tag=t")
SMALL += ("algorithm.regressor.trees=3", "scale.max_iterations=2", "env.starts=3")
SMALL += ("scale.max_episodes=4", "algorithm.epsilon=0.5", "env.success=absorbed")


def results(name, learner=None):
    """What two seeds learn in an odd environment."""
    if learner is None:
        learner = FQI(2, 5, Forest(trees=3), epsilon=0.5)
    task = Gymnasium(f"odd/{name}-v0", success="absorbed", starts=4)
    return run(stages([task], learner), [0, 1], progress=False)


@pytest.fixture(scope="module")
def plain():
    return results("Walk")


SAME = (odd.RewardInAnArray, odd.NumpyScalars, odd.EverythingInArrays, odd.OneBuffer)
SAME += (odd.ListsForArrays, odd.Row, odd.Bare, odd.InATuple, odd.InADict)
SAME += (odd.ActionsFrom5, odd.ModeWithoutDefault, odd.LegacySeed, odd.SignedSeed)
SAME += (odd.NoEarlyReset, odd.OrderedInfo, odd.CloseFails, odd.HoldsAFile)
SAME += (odd.WornByResets, odd.SeedsTheGlobal, odd.BothAtOnce, odd.EndsInNumbers)
SAME += (odd.InACoarserDict,)


@pytest.mark.parametrize("cls", SAME, ids=lambda cls: cls.__name__)
def test_what_is_adapted_gives_the_numbers_of_the_plain_one(cls, plain):
    pd.testing.assert_frame_equal(results(cls.__name__), plain)


def test_dqn_takes_adapted_environments_too():
    learner = DQN(40, 10, 10, evaluate_every=20, evaluation_episodes=2)
    plain = results("Walk", learner)
    for name in ("EverythingInArrays", "OneBuffer", "NoEarlyReset", "WornByResets"):
        pd.testing.assert_frame_equal(results(name, learner), plain)


@pytest.mark.parametrize(
    ("cls", "seen"),
    [
        (odd.Numbered, lambda at: np.eye(7)[at]),
        (odd.Several, lambda at: np.r_[np.eye(7)[at], np.eye(2)[at % 2]]),
        (odd.Bits, lambda at: np.array([at & 1, at >> 1 & 1, at >> 2 & 1], float)),
        (odd.Picture, lambda at: np.full(60, 30.0 * at)),
    ],
)
def test_observations_become_vectors(cls, seen):
    task, twin = (Gymnasium(f"odd/{c.__name__}-v0") for c in (cls, odd.Walk))
    lanes, plain = task.lanes(), twin.lanes()
    start = np.random.default_rng(0).random((9, 1))
    state, at = lanes.begin(start), plain.begin(start)
    for _ in range(3):
        np.testing.assert_array_equal(state, [seen(int(x)) for x in at[:, 0]])
        action = np.arange(9) % 2
        state, at = (x.step(None, action, None)[0] for x in (lanes, plain))


#: What each message has to name, besides env.id: the method, what came, what is right.
REFUSED = {
    odd.OldReset: ("reset", "array", "0.26"),
    odd.OldStep: ("step", "4 values", "truncated"),
    odd.NoSeed: ("reset", "seed", "reset(*, seed=None, options=None)"),
    odd.StepGivesNothing: ("step", "None", "5:"),
    odd.OtherShape: ("reset", "(1,)", "(3,)"),
    odd.Growing: ("step", "(3,)", "(2,)"),
    odd.TextSeen: ("reset", "<U1", "numbers"),
    odd.NothingSeen: ("reset", "None", "numbers"),
    odd.OutOfNumbers: ("Discrete(4)", "type int", "member"),
    odd.KeyMissing: ("reset", "'a'", "'b'"),
    odd.NoTuple: ("reset", "5.", "member of Tuple"),
    odd.NothingInside: ("reset", "nothing", "one number"),
    odd.NotANumber: ("step", "nan", "finite"),
    odd.RewardOfNothing: ("step", "reward None", "number"),
    odd.RewardAsText: ("step", "reward '-0.5'", "number"),
    odd.TwoRewards: ("step", "(2,)", "number"),
    odd.EndlessReward: ("step", "reward inf", "finite"),
    odd.EndsInWords: ("step", "terminated ''", "True or False"),
    odd.CutIsNothing: ("step", "truncated None", "True or False"),
    odd.InfoIsNothing: ("step", "info None", "dict"),
    odd.NotMade: ("constructor", "OSError: no simulator", "odd.py:"),
    odd.NoReset: ("reset", "KeyError: 'no map'", "odd.py:"),
    odd.NoStep: ("step", "IndexError: off the map", "odd.py:"),
    odd.Leaves: ("step", "SystemExit: bye", "odd.py:"),
    odd.Huge: ("reset", "e+300", "float32"),
    odd.NoSpace: ("observation_space", "None", "gymnasium"),
    odd.Words: ("observations", "Text", "filter_keys: [at]"),
    odd.Continuous: ("actions", "Box", "{name: DiscretizeAction, bins: 5}"),
    odd.SeveralActions: ("actions", "MultiDiscrete", "Discrete"),
    odd.Unseeded: ("reset", "episode 1", "reset(seed=…)"),
    odd.LateDice: ("step 71", "episode 1", "reset(seed=…)"),
    odd.OutlivesAll: ("reset", "episode 1", "outlives a reset"),
    odd.Shared: ("another", "expected", "share"),
    odd.Clock: ("reset", "episode 1", "same reset and actions"),
}


@pytest.mark.parametrize("cls", REFUSED, ids=lambda cls: cls.__name__)
def test_what_breaks_the_contract_is_refused_before_work(cls, tmp_path):
    name = f"odd/{cls.__name__}-v0"
    with pytest.raises(BcrlError) as refused:
        jobs.plans(arguments(*SMALL, f"env.id={name}", f"runs_dir={tmp_path}/runs"))
    text = str(refused.value)
    assert text.startswith(f"env.id={name}: ") and "\n" not in text
    for part in REFUSED[cls]:
        assert part in text
    assert refused.value.exit_code == 2 and not (tmp_path / "runs").exists()


def held() -> int:
    """Files that the process holds for odd environments."""
    links = []
    for number in os.listdir("/proc/self/fd"):
        try:
            links.append(os.readlink(f"/proc/self/fd/{number}"))
        except OSError:
            continue  # the listing's own
    return sum("held" in link for link in links)


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="counts open files")
def test_no_file_stays_open():
    learner = DQN(30, 10, 10, evaluate_every=15, evaluation_episodes=2)
    for each in (None, learner):
        results("HoldsAFile", each)
        gc.collect()
        assert held() == 0
    task = Gymnasium("odd/HoldsAFile-v0")
    lanes = task.lanes()
    lanes.begin(np.full((3, 1), 0.5))
    assert held() == 3
    del lanes
    gc.collect()
    assert held() == 0


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="counts open files")
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
    monkeypatch.setattr("bcrl.learning.rollout.AT_ONCE", 8)
    parts = rollout(task, q, start, u, epsilon=0.3)
    assert max(most) == 8 and held() == 0
    for name in ("state", "action", "reward", "absorbing", "length", "start"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name))


DQN_SMALL = ("algorithm=dqn", "algorithm.steps=40", "algorithm.random_steps=20")
DQN_SMALL += ("algorithm.learning_starts=20", "algorithm.evaluate_every=20")
DQN_SMALL += ("algorithm.evaluation_episodes=2",)


@pytest.mark.parametrize("more", [(), DQN_SMALL], ids=["FQI", "DQN"])
def test_a_simulator_that_fails_in_a_run_fails_its_seed_alone(more, tmp_path):
    small = [o for o in SMALL if not (more and o.startswith("algorithm."))]
    files = {}
    for doom in (0, 1):
        asked = (*small, *more, "env.id=odd/FailsLate-v0", "seeds.count=6")
        asked += (f"env.kwargs={{doom: {doom}}}", f"runs_dir={tmp_path}/{doom}")
        made = plan(*asked)
        if not doom:
            runner.run(made)
        else:
            with pytest.raises(
                runner.SeedsFailed, match=r"env\.id=odd/FailsLate-v0"
            ) as lost:
                runner.run(made)
            assert "RuntimeError: the motor is stuck (…/odd.py:" in str(lost.value)
        found = sorted(made.directory.glob("seed_*.json"))
        status = [json.loads(path.read_text())["status"] for path in found]
        files[doom] = [path.with_suffix(".csv").read_bytes() for path in found]
    fine = [s == "complete" for s in status]
    assert 0 < sum(fine) < 6
    for good, one, other in zip(fine, files[0], files[1], strict=True):
        assert not good or one == other


def test_one_message_and_no_traceback_from_the_command(bcrl, tmp_path):
    (tmp_path / "broken.py").write_text(
        "import gymnasium\nfrom gymnasium.envs.classic_control import CartPoleEnv\n\n\n"
        "class Broken(CartPoleEnv):\n    def step(self, action):\n"
        "        return super().step(action)[:4]\n\n\n"
        "gymnasium.register('Broken-v0', Broken, max_episode_steps=9)\n"
    )
    os.environ |= {"BCRL_TRUST": "broken", "PYTHONPATH": str(tmp_path)}
    try:
        done = bcrl(*SMALL, "env.id=broken:Broken-v0")
    finally:
        del os.environ["BCRL_TRUST"], os.environ["PYTHONPATH"]
    assert done.returncode == 2 and "Traceback" not in done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("bcrl: env.id=broken:Broken-v0: step gave 4 values")
    assert not (tmp_path / "runs").exists()


def test_what_info_says_of_success_has_to_be_true_or_false():
    simulator = Simulator(Gymnasium("odd/Walk-v0"))
    for value, expected in ((1, True), (np.array([True]), True), (False, False)):
        assert simulator._flag("step", {"success": value}) is expected
        assert simulator.reports
        simulator.reports = False
    for value in ("no", None, 0.3, np.nan, {}):
        assert not simulator._flag("step", {"success": value})
        assert not simulator.reports


def test_no_cast_hides_what_float32_cannot_tell_apart():
    seen = np.array([1.7e9 + 3])
    space = spaces.Dict({"time": spaces.Box(-np.inf, np.inf, (1,), np.float32)})
    simulator = Simulator(Gymnasium("odd/Walk-v0"))
    (found,) = simulator._parts("reset", space, {"time": seen})
    assert found[0] == seen[0]


def test_a_registered_threshold_of_zero_is_one():
    gymnasium.register("odd/Zero-v0", odd.Walk, 0.0, max_episode_steps=12)
    assert Gymnasium("odd/Zero-v0", success="threshold").success_threshold == 0.0
    task = Gymnasium("odd/Zero-v0")
    object.__setattr__(task, "success", "auto")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bcrl.envs.gymnasium.default", lambda *_: Success("threshold"))
        task._resolve_success(0.0)
    assert (task.success, task.success_threshold) == ("threshold", 0.0)
