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
from bcrl.errors import BcrlError, ConfigError
from bcrl.evaluation.step_metrics import evaluate
from bcrl.learning.rollout import play, starts_and_draws, success_of
from bcrl.learning.stage import SeedBatch
from bcrl.learning.transfer import StageInit
from tests.conftest import plan, plans
from tests.toys import last, snapshots

CAR = {"id": "MountainCar-v0", "horizon": 40}
MOODS = itertools.count()


class Counter(gymnasium.Env):
    """Counts its steps; `prize` at 5; truncates itself at 3 with `stop`."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gymnasium.spaces.Discrete(2, start=7)

    def __init__(self, stop=False, prize=1.0, moody=False, sums=None):
        self.stop, self.prize, self.own = stop, prize, 2.0
        self.moody, self.sums = moody, sums or [0.0]

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.own = 0, 2.0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.steps += 1
        self.sums[0] += 1.0
        end, cut = self.steps == 5, self.stop and self.steps == 3
        seen = np.full(1, self.steps + (next(MOODS) if self.moody else 0), np.float32)
        return seen, self.prize * end, end, cut, {}


class Scored(Counter):
    """Reports success in info after every step with action 8."""

    def step(self, action):
        *found, _ = super().step(action)
        return *found, {"is_success": np.array([action == 8])}


gymnasium.register("tests/Counter-v0", Counter, max_episode_steps=9)
gymnasium.register("tests/Endless-v0", Counter)
gymnasium.register("tests/Scored-v0", Scored, max_episode_steps=9)


def played(task, episodes=3):
    """Random episodes of seed 0, and the seeds of their resets."""
    rng = stream(0, "data", 1)
    start, u = starts_and_draws([rng], task, episodes)

    def policy(now, u, alive):
        return (u[..., 1] * task.n_actions).astype(np.intp)

    resets = [int(number * 2**31) for number in start[0, :, 0]]
    return play(task, policy, start, u), resets


def test_terminated_is_absorbing_and_truncated_is_not():
    ended, _ = played(Gymnasium("tests/Counter-v0"))
    assert (ended.length == 5).all() and ended.absorbing[..., 4].all()
    assert ended.solved("absorbed").all() and not ended.solved("survived").any()
    for length, how in ((3, {"kwargs": {"stop": True}}), (4, {"horizon": 4})):
        cut, _ = played(Gymnasium("tests/Counter-v0", **how))
        assert (cut.length == length).all() and not cut.absorbing.any()
        assert cut.solved("survived").all() and not cut.solved("absorbed").any()


def test_truncation_bootstraps_in_dqn():
    learner = DQN(steps=60, random_steps=0, learning_starts=10, replay_size=60)
    task = Gymnasium("tests/Counter-v0", kwargs={"stop": True})
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
            x = np.maximum(x, 0) if n_in != 2 else x
            x = x @ weights + flat[at - n_out : at]
        found = evaluate(now, team.seeds)[0][1]["q_mean"]
        assert found == pytest.approx(x.max(-1).mean(), rel=1e-5)


FEW = FQI(iterations=2, episodes=4, regressor=Forest(trees=3), epsilon=0.5)


@pytest.mark.parametrize("learner", [FEW, DQN(90, 20, 30, evaluate_every=45)])
def test_a_seed_is_the_same_alone_and_in_a_batch(learner):
    cars = [{"attributes": {"force": force}} for force in (0.004, 0.003)]
    tasks = [Gymnasium(**CAR, **car, starts=3) for car in cars]
    course = stages(tasks, learner, Boost())
    together = run(course, seeds=range(3), progress=False)
    own = together[together.seed == 2].reset_index(drop=True)
    assert own.equals(run(course, seeds=[2], progress=False))
    assert len(set(together.groupby("seed")["return"].sum())) > 1


def test_lanes_from_a_checkpoint_continue_in_the_middle_of_an_episode(tmp_path):
    task = Gymnasium("CartPole-v1", horizon=30)
    lanes, rng = task.lanes(), np.random.default_rng(0)
    state = lanes.begin(rng.random((4, 1)))
    for _ in range(20):
        state, _, over, _ = lanes.step(state, rng.integers(2, size=4), None)
        state = lanes.restart(over, rng.random((4, 1)), state)
    with open(tmp_path / "x.npz", "wb") as file:
        serialization.write(file, {}, lanes, [task])
    again = serialization.read_content(tmp_path / "x.npz", [task])
    for action in rng.integers(2, size=(5, 4)):
        found = [each.step(state, action, None) for each in (lanes, again)]
        for a, b in zip(*found, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_replay_that_ends_elsewhere_fails_its_lane():
    lanes = Gymnasium("CartPole-v1", horizon=30).lanes()
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
    task = Gymnasium("tests/Counter-v0", kwargs={"sums": [0.0]})
    lanes = task.lanes()
    lanes.begin(np.full((2, 1), 0.5))
    lanes.step(None, np.zeros(2, int), None)
    assert [each.env.unwrapped.sums for each in lanes.simulators] == [[1.0], [1.0]]
    assert task.kwargs == {"sums": [0.0]}


@pytest.mark.parametrize("env", ["mountain_car", "cart_pole", "acrobot"])
def test_shipped_curricula_apply_their_parameters(env):
    for task in plan(f"env={env}").tasks:
        there = task.make().unwrapped
        for key, value in task.attributes.items():
            assert getattr(there, key) == value
        if env == "cart_pole":
            derived = there.masspole * there.length
            assert there.polemass_length == pytest.approx(derived)


def test_an_id_of_the_command_names_the_folder():
    asked = ("env=gymnasium", "env.id=tests/Counter-v0")
    assert str(plan(*asked).directory) == "runs/quick/tests-Counter-v0/FQI"
    asked += ("env.kwargs=null", "env.tasks.kwargs=[{prize: 1.0},{prize: 2.0}]")
    own, other = (plan(*asked, f"variant={variant}") for variant in ("BC", "C"))
    assert own.tag == other.tag and own.name.startswith("BC-FQI@")


STACK = "{name: FrameStackObservation, stack_size: 2}"
#: Overrides, and words of the message.
BAD = {
    "env.id=CartPol-v1": "did you mean env.id=CartPole-v1?",
    "env.id=no_such:CartPole-v1": "can't be imported",
    "env.id=Pendulum-v1": "{name: DiscretizeAction",
    "env.id=tests/Endless-v0": "env.horizon",
    "env.kwargs={prise: 2.0}": "did you mean prize?",
    "env.kwargs={render_mode: human}": "is set by bcrl",
    "env.kwargs={moody: true}": "same reset and actions",
    "env.attributes={priz: 2}": "did you mean prize?",
    "env.attributes={action_space: 2}": "action_space",
    "env.attributes={prize: x}": "must be like 1.0",
    "env.attributes={prize: [1, 2]}": "must be like 1.0",
    "env.attributes={prize: nan}": "and finite",
    "env.attributes={own: 3.0}": "again after a reset",
    "env.horizon=0": "env.horizon=0",
    "env.wrappers=[{name: FrameStackObservation, stack_size: 0}]": "FrameStackObserv",
    "env.wrappers=[{name: RecordVideo}]": "known:",
    "env.wrappers=[StickyAction]": "needs a name",
    "env.wrappers=[{name: StickyAction, prob: 0.1}]": "repeat_action_probability",
    "env.wrappers=[{name: gymnasium.wrappers.RecordVideo}]": "env.wrappers=",
    "env.observation=os.nope": "os has no nope",
    "env.success=survive": "did you mean survived?",
    "env.success=threshold": "env.success_threshold",
    "env.starts=0": "env.starts",
    "env.kwargs={prize: 1.0} env.tasks.kwargs=[{prize: 2.0},{}]": "env.tasks.kwargs",
    f"env.tasks.wrappers=[[{STACK}],[]]": "state_dim",
    "env.action_vectors=[[1]]": "must be 2 vectors",
    "env.metrics=[q_error]": "no Q*",
}


@pytest.mark.parametrize("overrides", BAD)
def test_a_wrong_value_is_rejected_before_work(overrides):
    given = overrides.replace(" env.", "\0env.").split("\0")
    if not overrides.startswith("env.id"):
        given.append("env.id=tests/Counter-v0")
    with pytest.raises(BcrlError) as error:
        plans("env=gymnasium", *given)
    assert BAD[overrides] in str(error.value)


def test_residual_policies_need_action_vectors():
    given = ("env=mountain_car", "algorithm=dqn", "env.action_vectors=null")
    with pytest.raises(BcrlError, match=r"env\.action_vectors"):
        plans(*given, "curriculum=on", "transfer=residual_policy")


def test_a_function_joins_tasks_with_different_observations(tmp_path, monkeypatch):
    (tmp_path / "my_maps.py").write_text(
        "import numpy as np\n\n\ndef padded(seen):\n"
        "    return np.resize([*seen, 0.0, 0.0], 2)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("BCRL_TRUST", "my_maps")
    stacked = [{"name": "FrameStackObservation", "stack_size": 2}]
    ways = {"observation": "my_maps.padded"}, {"wrappers": stacked}
    tasks = [Gymnasium("tests/Counter-v0", **way) for way in ways]
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
    "tests/Counter-v0": (UNPUNISHED, "unpunished", lambda r, end, info: False),
    "Taxi-v4": (CHEAP, "threshold", lambda r, end, info: sum(r) >= -160),
    "tests/Scored-v0": ({}, "info", lambda r, end, info: bool(info["is_success"][0])),
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
    if name in ("CartPole-v1", "Taxi-v4", "tests/Scored-v0"):
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


#: An id that is not registered, and what to type.
UNKNOWN = {
    "MiniGrid-Empty-5x5-v0": "env.id=minigrid:MiniGrid-Empty-5x5-v0",
    "ALE/Pong-v5": "env.id=ale_py:ALE/Pong-v5",
    "cartpole": "env.id=CartPole-v1",
    "MountainCar-v9": "env.id=MountainCar-v0",
    "Nothing-like-it-v0": "env.id=module:Name-v0",
    "miniworld:MiniWorld-Maze-v0": "pip install miniworld",
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_an_id_that_is_not_registered_gets_the_line_to_type(name, monkeypatch):
    monkeypatch.delitem(gymnasium.registry, name, raising=False)
    with pytest.raises(ConfigError, match=f"^env.id={name}: .*{UNKNOWN[name]}"):
        Gymnasium(name)


def test_trusting_gymnasium_breaks_nothing(monkeypatch):
    monkeypatch.setenv("BCRL_TRUST", "gymnasium,fqi,maze")
    (made,) = plans("env=gymnasium", "env.id=gymnasium:CartPole-v1")
    assert made.target.n_actions == 2
    assert plan("env=maze").target.name == "maze"


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
