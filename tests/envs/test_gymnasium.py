"""Gymnasium's environments as tasks: same episodes, kept apart, replayed, checked."""

import itertools
from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from bcrl.api import DQN, FQI, Boost, Forest, Gymnasium, run, stages
from bcrl.common import serialization
from bcrl.common.seeding import stream
from bcrl.envs.base import default_success
from bcrl.envs.checks import unresolved
from bcrl.envs.compiled_lanes import CompiledLanes
from bcrl.envs.simulators import SimulatedLanes
from bcrl.errors import ConfigError
from bcrl.evaluation.step_metrics import evaluate
from bcrl.learning.rollout import play, starts_and_draws, success_of
from bcrl.learning.stage import SeedBatch
from bcrl.learning.transfer import StageInit
from tests.envs.counter import COUNTER, SCORED
from tests.toys import last, snapshots

CAR = {"id": "MountainCar-v0", "horizon": 40}


def played(task, episodes=3):
    """Random episodes of seed 0, and the seeds of their resets."""
    start, u = starts_and_draws([stream(0, "data", 1)], task, episodes)

    def policy(now, u, alive):
        return (u[..., 1] * task.n_actions).astype(np.intp)

    return play(task, policy, start, u), [int(x * 2**31) for x in start[0, :, 0]]


def test_terminated_is_absorbing_and_truncated_is_not():
    ended, _ = played(Gymnasium(COUNTER))
    assert (ended.length == 5).all() and ended.absorbing[..., 4].all()
    assert ended.solved("absorbed").all() and not ended.solved("survived").any()
    for length, how in ((3, {"kwargs": {"stop": True}}), (4, {"horizon": 4})):
        cut, _ = played(Gymnasium(COUNTER, **how))
        assert (cut.length == length).all() and not cut.absorbing.any()
        assert cut.solved("survived").all() and not cut.solved("absorbed").any()


def test_truncation_bootstraps_in_dqn():
    learner = DQN(steps=60, random_steps=0, learning_starts=10, replay_size=60)
    task = Gymnasium(COUNTER, kwargs={"stop": True})
    (stage,) = stages([task], learner)
    batch = SeedBatch((0,), task.evaluation_states())
    replay = last(learner.learn(stage, StageInit(), batch)).state.replay
    kept = replay.rows[0, : replay.size]
    position, discount = kept[:, 0], kept[:, 2 + task.n_actions + 1]
    assert set(position.tolist()) == {0.0, 1.0, 2.0}  # anew after three steps
    assert (discount == np.float32(task.gamma)).all()


def test_q_mean_is_that_of_the_first_observations():
    """Against plain Gymnasium and NumPy."""
    task, seed, n = Gymnasium(**CAR), 5, 7
    learner = DQN(20, 5, 10, hidden=(9, 6), evaluate_every=20, evaluation_episodes=n)
    (stage,) = stages([task], learner)
    team = SeedBatch((3, seed), np.zeros((1, 2)))
    env = gymnasium.make(CAR["id"])
    for now in snapshots(learner.learn(stage, StageInit(), team)):
        resets = stream(seed, "evaluation", 1, now.count).random(n) * 2**31
        x = np.stack([env.reset(seed=int(number))[0] for number in resets])
        flat, at = now.result.residual.online.flat[1].detach().numpy(), 0
        for n_in, n_out in itertools.pairwise((2, 9, 6, 3)):
            weights = flat[at : at + n_in * n_out].reshape(n_in, n_out)
            at += n_in * n_out + n_out
            x = (np.maximum(x, 0) if n_in != 2 else x) @ weights + flat[at - n_out : at]
        found = evaluate(now, team.seeds)[0][1]["q_mean"]
        assert found == pytest.approx(x.max(-1).mean(), rel=1e-5)


FEW = FQI(iterations=2, episodes=4, regressor=Forest(trees=3), epsilon=0.5)


@pytest.mark.parametrize("learner", [FEW, DQN(90, 20, 30, evaluate_every=45)])
def test_a_seed_is_the_same_alone_and_in_a_batch(learner):
    tasks = [Gymnasium(**CAR, attributes={"force": f}, starts=3) for f in (4e-3, 3e-3)]
    course = stages(tasks, learner, Boost())
    together = run(course, seeds=range(3), progress=False)
    own = together[together.seed == 2].reset_index(drop=True)
    assert own.equals(run(course, seeds=[2], progress=False))
    assert len(set(together.groupby("seed")["return"].sum())) > 1


@pytest.mark.parametrize("kind", [SimulatedLanes, CompiledLanes])
def test_lanes_from_a_checkpoint_continue_in_the_middle_of_an_episode(kind, tmp_path):
    task = Gymnasium("CartPole-v1", horizon=30)
    lanes, rng = kind(task), np.random.default_rng(0)
    state = lanes.begin(rng.random((4, 1)))
    for _ in range(20):
        state, _, over, _ = lanes.step(state, rng.integers(2, size=4), None)
        state = lanes.restart(over, rng.random((4, 1)), state)
    with open(tmp_path / "x.npz", "wb") as file:
        serialization.write_content(file, {}, lanes, [task])
    again = serialization.read_content(tmp_path / "x.npz", [task])
    for action in rng.integers(2, size=(5, 4)):
        found = [each.step(state, action, None) for each in (lanes, again)]
        for a, b in zip(*found, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_replay_that_ends_elsewhere_fails_its_lane():
    lanes = SimulatedLanes(Gymnasium("CartPole-v1", horizon=30))
    state = lanes.begin(np.full((3, 1), 0.25))
    lanes.step(state, np.ones(3, int), None)
    lanes.close()
    lanes.simulators[1].seen[0] += 1e-9
    after, *_, cut = lanes.step(state, np.ones(3, int), None)
    assert list(lanes.failures) == [1] and "replay" in lanes.failures[1]
    assert cut.tolist() == [False, True, False] and not after[1].any()
    assert not lanes.restart(np.ones(3, bool), np.full((3, 1), 0.5), after)[1].any()


def test_a_parameter_without_an_effect_is_found():
    # The dynamics use the centre of mass.
    attributes = [{"LINK_LENGTH_2": length} for length in (1.0, 2.0)]
    tasks = [Gymnasium("Acrobot-v1", attributes=a, horizon=20) for a in attributes]
    with pytest.raises(ConfigError, match="behave alike"):
        Gymnasium.check_tasks(tasks)
    Gymnasium.check_tasks([replace(task, verify=False) for task in tasks])


def test_a_simulator_has_its_constants_to_itself():
    task = Gymnasium(COUNTER, kwargs={"sums": [0.0]})
    lanes = task.lanes()
    lanes.begin(np.full((2, 1), 0.5))
    lanes.step(None, np.zeros(2, int), None)
    assert [each.env.unwrapped.sums for each in lanes.simulators] == [[1.0], [1.0]]
    assert task.kwargs == {"sums": [0.0]}


def test_a_function_joins_tasks_with_different_observations(tmp_path, monkeypatch):
    text = "import numpy\ndef padded(x): return numpy.resize([*x, 0.0, 0.0], 2)\n"
    (tmp_path / "my_maps.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("BCRL_TRUST", "my_maps")
    stacked = [{"name": "FrameStackObservation", "stack_size": 2}]
    ways = {"observation": "my_maps.padded"}, {"wrappers": stacked}
    tasks = [Gymnasium(COUNTER, **way) for way in ways]
    found = run(stages(tasks, FEW, Boost()), seeds=[0], progress=False)
    assert list(found.task) == [1, 1, 2, 2]


UNPUNISHED = {"success": "unpunished", "kwargs": {"prize": -1.0}}
CHEAP = {"success_threshold": -160, "horizon": 40}
STRONG = {"horizon": 40, "attributes": {"force": 0.004}}
#: Fields, the rule that results, and what it says of rewards, end and info.
SOLVED = {
    "FrozenLake-v1": ({}, "rewarded", lambda r, end, info: end and r[-1] > 0),
    "CliffWalking-v1": ({"horizon": 40}, "absorbed", lambda r, end, info: end),
    "CartPole-v1": ({"horizon": 25}, "survived", lambda r, end, info: not end),
    COUNTER: (UNPUNISHED, "unpunished", lambda r, end, info: False),
    "Taxi-v4": (CHEAP, "threshold", lambda r, end, info: sum(r) >= -160),
    SCORED: ({}, "info", lambda r, end, info: bool(info["is_success"][0])),
    "MountainCar-v0": (STRONG, "absorbed", lambda r, end, info: end),
}


@pytest.mark.parametrize("name", SOLVED)
def test_episodes_are_those_of_a_plain_loop(name):
    changes, rule, expected = SOLVED[name]
    if name not in gymnasium.registry:
        pytest.skip("of another version of Gymnasium")
    task = Gymnasium(name, **changes)
    assert task.success == rule
    found, resets = played(task, episodes=40)
    kwargs = {"max_episode_steps": task.horizon, **changes.get("kwargs", {})}
    env = gymnasium.make(name, **kwargs)
    for key, value in changes.get("attributes", {}).items():
        setattr(env.unwrapped, key, value)
    counted = []
    for lane, seed in enumerate(resets):
        seen, _ = env.reset(seed=seed)
        rewards, end, cut = [], False, False
        while not (end or cut):
            flat = gymnasium.spaces.flatten(env.observation_space, seen)
            np.testing.assert_array_equal(found.state[0, lane, len(rewards)], flat)
            action = found.action[0, lane, len(rewards)] + env.action_space.start
            seen, reward, end, cut, info = env.step(int(action))
            rewards.append(reward)
        assert found.reward[0, lane, : len(rewards)].tolist() == rewards
        counted.append(bool(expected(rewards, end, info)))
    assert found.solved(success_of(task))[0].tolist() == counted
    if name in ("CartPole-v1", "Taxi-v4", SCORED):
        assert 0 < sum(counted) < 40


def test_the_default_rule():
    for *known, rule in (
        (True, -1, -1, 5.0, "info"),
        (False, -1, -1, -110.0, "absorbed"),  # MountainCar
        (False, 1, 1, 475.0, "survived"),  # CartPole
        (False, 0, 0, 0.7, "rewarded"),  # FrozenLake
        (False, -10, -1, 8.0, "rewarded"),  # Taxi
        (False, -9, -1, -3.75, "threshold"),  # Reacher
        (False, -100, -1, None, "absorbed"),  # CliffWalking
        (False, -3, 2, 200.0, "threshold"),  # LunarLander
        (False, -1, 1, None, "rewarded"),  # Pong
        (False, 0.5, 2, None, "survived"),
    ):
        assert default_success(*known) == rule


def test_a_component_that_float32_does_not_resolve_is_noted():
    cells = np.random.default_rng(0).integers(7, size=(200, 1))
    assert not unresolved(np.hstack([np.cos(cells), cells]))
    for offset, scale in ((1.7e9, 1.0), (0.0, 1e-8), (1e3, 1e-5)):
        seen = np.hstack([np.cos(cells), offset + scale * cells])
        assert unresolved(seen).startswith("component 1 ")


def test_a_note_names_the_flattened_space_and_the_wrapper():
    (note,) = Gymnasium("FrozenLake-v1").trial.notes
    assert "Discrete(16)" in note and "FlattenObservation" in note
    assert not Gymnasium("CartPole-v1").trial.notes
