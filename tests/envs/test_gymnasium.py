"""Gymnasium's environments as tasks: same episodes, kept apart, replayed, checked."""

import itertools
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from torch.nn import functional

from bcrl.api import DQN, FQI, Boost, Forest, Gymnasium, run, stages
from bcrl.common import serialization
from bcrl.common.seeding import stream
from bcrl.envs._success import default
from bcrl.envs._trial import coarse, trial
from bcrl.errors import BcrlError, ConfigError
from bcrl.evaluation.step_metrics import evaluate
from bcrl.learning.rollout import draws, play, start_states, success_of
from bcrl.learning.stage import SeedBatch, snapshots
from bcrl.learning.transfer import StageInit
from bcrl.q.quadratic import Quadratic
from bcrl.run import runner
from tests.conftest import plan, plans
from tests.toys import last

CAR = {"id": "MountainCar-v0", "horizon": 40}
CURRICULA = ("mountain_car", "cart_pole", "acrobot")


MOODS = itertools.count()


class Counter(gymnasium.Env):
    """Counts its steps; `prize` at 5; truncates itself at 3 if told so."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gymnasium.spaces.Discrete(2, start=7)

    def __init__(self, stop=False, prize=1.0, broken=False, moody=False, sums=(0,)):
        self.stop, self.prize, self.broken, self.own = stop, prize, broken, 2.0
        self.moody, self.sums = moody, sums

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.own = 0, 2.0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.steps += 1
        if isinstance(self.sums, list):
            self.sums[0] += 1.0
        end, cut = self.steps == 5, self.stop and self.steps == 3
        seen = np.full(1, np.nan if self.broken else self.steps, np.float32)
        if self.moody:
            seen += next(MOODS)
        return seen, self.prize * end, end, cut, {}


gymnasium.register("tests/Counter-v0", Counter, max_episode_steps=9)
gymnasium.register("tests/Endless-v0", Counter)


def played(task, episodes=3, seed=0):
    """Random episodes of one seed."""
    rng = stream(seed, "data", 1)
    start = start_states(rng, task, episodes)[None]
    u = draws(rng, task, episodes)[None]

    def policy(now, u, alive):
        return (u[..., 1] * task.n_actions).astype(np.intp)

    return play(task, policy, start, u)


def test_episodes_are_those_of_gymnasium_itself():
    task = Gymnasium(**CAR, attributes={"force": 0.004})
    found = played(task)
    starts = start_states(stream(0, "data", 1), task, 3)
    env = gymnasium.make("MountainCar-v0", max_episode_steps=40)
    env.unwrapped.force = 0.004
    for lane, draw in enumerate(starts[:, 0]):
        seen, _ = env.reset(seed=int(draw * 2**31))
        for t in range(found.length[0, lane]):
            np.testing.assert_array_equal(found.state[0, lane, t], seen)
            seen, reward, *_ = env.step(int(found.action[0, lane, t]))
            assert reward == found.reward[0, lane, t]


def test_terminated_is_absorbing_and_truncated_is_not():
    ended, cut = (
        played(Gymnasium("tests/Counter-v0", kwargs={"stop": stop}))
        for stop in (False, True)
    )
    assert (ended.length == 5).all() and ended.absorbing[..., 4].all()
    assert (cut.length == 3).all() and not cut.absorbing.any()
    assert ended.solved("absorbed").all() and not ended.solved("survived").any()
    assert not cut.solved("absorbed").any()
    limited = played(Gymnasium("tests/Counter-v0", horizon=4))
    assert (limited.length == 4).all() and not limited.absorbing.any()
    assert limited.solved("survived").all()


def test_truncation_bootstraps_in_dqn():
    learner = DQN(steps=60, random_steps=0, learning_starts=10, replay_size=60)
    task = Gymnasium("tests/Counter-v0", kwargs={"stop": True})
    moments = list(learner.learn(*_alone(task, learner)))
    replay = moments[-1].state()["replay"]
    kept = replay.rows[0, : replay.size]
    position, discount = kept[:, 0], kept[:, 2 + task.n_actions + 1]
    assert set(position.tolist()) == {0.0, 1.0, 2.0}  # anew after three steps
    assert (discount == np.float32(task.gamma)).all()


def test_q_mean_is_that_of_the_first_observations():
    """Against plain Gymnasium and torch's own layers."""
    task, seed, n = Gymnasium(**CAR), 5, 7
    learner = DQN(20, 5, 10, hidden=(9, 6), evaluate_every=20, evaluation_episodes=n)
    (stage,) = stages([task], learner)
    team = SeedBatch((3, seed), np.zeros((1, 2)))
    env = gymnasium.make(CAR["id"])
    for now in snapshots(learner.learn(stage, StageInit(), team)):
        resets = stream(seed, "evaluation", 1, now.count).random(n) * 2**31
        seen = np.stack([env.reset(seed=int(number))[0] for number in resets])
        sizes, flat, at = (2, 9, 6, 3), now.learned.residual.online.flat[1], 0
        x = torch.from_numpy(seen)
        for layer, (n_in, n_out) in enumerate(itertools.pairwise(sizes)):
            weights = flat[at : at + n_in * n_out].view(n_in, n_out)
            at += n_in * n_out + n_out
            x = functional.linear(x, weights.T, flat[at - n_out : at])
            x = functional.relu(x) if layer < 2 else x
        expected = x.max(-1).values.mean().item()
        found = evaluate(now, team.seeds)[1]["q_mean"]
        assert found == pytest.approx(expected, rel=1e-5)


def test_what_resets_a_simulator_is_refused_as_a_state():
    task = Gymnasium(**CAR)
    numbers = task.initial(np.full((1, 4, 1), 0.5))
    (stage,) = stages([task], DQN(3, 0, hidden=(4,), evaluation_episodes=1))
    deep = last(
        snapshots(stage.learner.learn(stage, StageInit(), SeedBatch((0,), numbers)))
    )
    quadratic = Quadratic(np.eye(3)[None], np.zeros((1, 3)), np.ones((2, 1)))
    for q in (deep.learned.q, quadratic):
        for states in (numbers, list(numbers)):
            with pytest.raises(BcrlError, match=r"2 entries.* 1"):
                q(states, 3)


def _alone(task, learner):
    from bcrl.learning.stage import SeedBatch
    from bcrl.learning.transfer import StageInit

    (stage,) = stages([task], learner)
    return stage, StageInit(), SeedBatch((0,), task.evaluation_states())


@pytest.mark.parametrize("family", ["FQI", "DQN"])
def test_a_seed_is_the_same_in_any_company(family):
    forces = [{"force": 0.004}, {"force": 0.003}]
    tasks = [Gymnasium(**CAR, attributes=each, starts=3) for each in forces]
    learner = FQI(iterations=2, episodes=4, regressor=Forest(trees=3), epsilon=0.5)
    if family == "DQN":
        learner = DQN(steps=90, random_steps=20, learning_starts=30, evaluate_every=45)
    course = stages(tasks, learner, Boost())
    together = run(course, seeds=range(3), progress=False)
    alone = run(course, seeds=[2], progress=False)
    own = together[together.seed == 2].reset_index(drop=True)
    assert own.equals(alone)
    assert len(set(together.groupby("seed")["return"].sum())) > 1


def test_lanes_out_of_a_checkpoint_go_on_in_the_middle_of_an_episode(tmp_path):
    task = Gymnasium("CartPole-v1", horizon=30)
    lanes, rng = task.lanes(), np.random.default_rng(0)
    state = lanes.begin(rng.random((4, 1)))
    for _ in range(20):
        state, _, ended, cut = lanes.step(state, rng.integers(2, size=4), None)
        over = ended | cut | (lanes.length == task.horizon)
        state = lanes.restart(over, rng.random((4, 1)), state)
    with open(tmp_path / "x.npz", "wb") as file:
        serialization.write(file, {}, lanes, [task])
    again = serialization.read(tmp_path / "x.npz", [task])
    assert not again.running  # no simulator is stored
    for action in rng.integers(2, size=(5, 4)):
        for a, b in zip(
            lanes.step(state, action, None),
            again.step(state, action, None),
            strict=True,
        ):
            np.testing.assert_array_equal(a, b)


def test_a_parameter_that_is_not_applied_is_found():
    for lengths in ((1.0, 2.0), (1.0, 1.0)):  # the dynamics use the centre of mass
        attributes = [{"LINK_LENGTH_2": length} for length in lengths]
        tasks = [Gymnasium("Acrobot-v1", attributes=a) for a in attributes]
        with pytest.raises(ConfigError, match="behave alike"):
            Gymnasium.check_tasks(tasks)
        Gymnasium.check_tasks([replace(task, verify=False) for task in tasks])


def test_randomness_that_a_reset_does_not_seed_is_found():
    with pytest.raises(ConfigError, match="same reset and actions"):
        plans("env=gymnasium", "env.id=tests/Counter-v0", "env.kwargs={moody: true}")


def test_a_simulator_has_its_constants_to_itself():
    task = Gymnasium("tests/Counter-v0", kwargs={"sums": [0.0]})
    lanes = task.lanes()
    lanes.begin(np.full((2, 1), 0.5))
    lanes.step(None, np.zeros(2, int), None)
    assert [lane.env.unwrapped.sums for lane in lanes.running] == [[1.0], [1.0]]
    assert task.kwargs == {"sums": [0.0]}


def test_equal_tasks_have_equal_hashes():
    one, other = (Gymnasium(**CAR, attributes={"force": f}) for f in (1, 1.0))
    assert one == other and hash(one) == hash(other)


@pytest.mark.parametrize("env", CURRICULA)
def test_shipped_curricula_apply_their_parameters(env):
    tasks = plan(f"env={env}").tasks
    for task in tasks:
        there = task.simulator().unwrapped
        for key, value in task.attributes.items():
            assert getattr(there, key) == value
    if env == "cart_pole":
        for task in tasks:
            there = task.simulator().unwrapped
            derived = there.masspole * there.length
            assert there.polemass_length == pytest.approx(derived)


@pytest.mark.parametrize("env", CURRICULA)
def test_all_variants_compose(env):
    variants = "variant=plain,C,B,BC,SC,SBC"
    made = plans(f"env={env}", "algorithm=dqn,fqi", variants, multirun=True)
    assert len({p.directory for p in made}) == 12
    assert not any(p.tag for p in made)


@pytest.mark.parametrize("env", CURRICULA)
def test_fqi_and_dqn_run_in_every_variant(env, tmp_path):
    small = ("scale=smoke", "seeds.count=1", "env.horizon=12", f"runs_dir={tmp_path}")
    small += ("scale.max_episodes=3", "env.starts=2", "progress=none", "tag=x")
    own = {
        "fqi": ("algorithm.regressor.trees=2",),
        "dqn": ("scale.max_steps=30", "algorithm.learning_starts=10"),
    }
    own["dqn"] += ("algorithm.random_steps=5", "algorithm.evaluation_episodes=2")
    made = [
        each
        for name, more in own.items()
        for each in plans(
            f"env={env}",
            f"algorithm={name}",
            "variant=plain,C,B,BC",
            *small,
            *more,
            multirun=True,
        )
    ]
    runner.run(*made)
    names = {path.parent.name for path in tmp_path.glob(f"smoke/{env}/*/*.csv")}
    variants = [f"{v}{a}@x" for a in ("FQI", "DQN") for v in ("", "C-", "B-", "BC-")]
    assert names == set(variants)


def test_an_id_of_the_command_names_the_folder():
    id_, tasks = (
        "env.id=CartPole-v1",
        "env.tasks.attributes=[{gravity: 5.0},{gravity: 9.8}]",
    )
    (alone,) = plans("env=gymnasium", id_)
    assert str(alone.directory) == "runs/quick/CartPole-v1/FQI"
    (own,) = plans("env=gymnasium", id_, tasks, "variant=BC")
    (other,) = plans("env=gymnasium", id_, tasks, "variant=C")
    assert own.tag == other.tag and own.name.startswith("BC-FQI@")
    (space,) = plans("env=gymnasium", "env.id=tests/Counter-v0")
    assert space.directory.parts[-2] == "tests-Counter-v0"


BAD = {
    "no id": ([], "env.id"),
    "a misspelt id": (["env.id=CartPol-v1"], "did you mean CartPole-v1?"),
    "a foreign module": (["env.id=no_such:CartPole-v1"], "can't be imported"),
    "continuous actions": (["env.id=Pendulum-v1"], "{name: DiscretizeAction"),
    "no horizon": (["env.id=tests/Endless-v0"], "env.horizon"),
    "an unknown argument": (["env.kwargs={prise: 2.0}"], "did you mean prize?"),
    "our argument": (["env.kwargs={render_mode: human}"], "is set by bcrl"),
    "an unknown attribute": (["env.attributes={priz: 2}"], "did you mean prize?"),
    "a hidden attribute": (["env.attributes={_np_random: 2}"], "_np_random"),
    "no plain attribute": (["env.attributes={action_space: 2}"], "action_space"),
    "text for a number": (["env.attributes={prize: x}"], "must be like 1.0"),
    "nothing for a number": (["env.attributes={prize: null}"], "must be like 1.0"),
    "a list for a number": (["env.attributes={prize: [1, 2]}"], "must be like 1.0"),
    "no finite number": (["env.attributes={prize: nan}"], "must be finite"),
    "a horizon of 0": (["env.horizon=0"], "env.horizon=0"),
    "a wrapper that can't": (
        ["env.wrappers=[{name: FrameStackObservation, stack_size: 0}]"],
        "env.wrappers.FrameStackObservation",
    ),
    "a reset attribute": (["env.attributes={own: 3.0}"], "again after a reset"),
    "an unknown wrapper": (["env.wrappers=[{name: RecordVideo}]"], "known:"),
    "a nameless wrapper": (["env.wrappers=[StickyAction]"], "needs a name"),
    "a wrapper's argument": (
        ["env.wrappers=[{name: StickyAction, prob: 0.1}]"],
        "repeat_action_probability",
    ),
    "an untrusted map": (["env.observation=os.nope"], "os has no nope"),
    "success": (["env.success=survive"], "did you mean survived?"),
    "no starts": (["env.starts=0"], "env.starts"),
    "two kinds of task": (
        ["env.kwargs={prize: 1.0}", "env.tasks.kwargs=[{prize: 2.0},{}]"],
        "env.tasks.kwargs decides",
    ),
    "tasks of other sizes": (
        ["env.tasks.wrappers=[[{name: FrameStackObservation, stack_size: 2}],[]]"],
        "state_dim",
    ),
    "no vectors": (["transfer=residual_policy"], "env.action_vectors"),
    "wrong vectors": (["env.action_vectors=[[1]]"], "must be 2 vectors"),
    "q_error": (["env.metrics=[q_error]"], "no Q*"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_is_refused_before_work(name):
    overrides, words = BAD[name]
    given = [] if name == "no id" else ["env.id=tests/Counter-v0"]
    given = [o for o in given if not any(x.startswith("env.id") for x in overrides)]
    if name == "no vectors":
        given += ["algorithm=dqn", "curriculum=on"]
        given += ["env.tasks.kwargs=[{prize: 1.0},{prize: 2.0}]"]
    with pytest.raises(BcrlError) as error:
        plans("env=gymnasium", *given, *overrides)
    assert words in str(error.value)


def test_values_that_are_not_finite_are_an_error_by_name():
    with pytest.raises(BcrlError, match=r"tests/Counter-v0: step gave .* nan .*finite"):
        Gymnasium("tests/Counter-v0", kwargs={"broken": True})


def test_a_map_joins_tasks_with_different_observations(tmp_path, monkeypatch):
    (tmp_path / "my_maps.py").write_text(
        "import numpy as np\n\n\ndef padded(seen):\n"
        "    return np.resize([*seen, 0.0, 0.0], 2)\n\n\n"
        "def cell(seen):\n    return np.array([seen // 4, seen % 4], float)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("BCRL_TRUST", "my_maps")
    timed = [{"name": "FrameStackObservation", "stack_size": 2}]
    tasks = [
        Gymnasium("tests/Counter-v0", observation="my_maps.padded"),
        Gymnasium("tests/Counter-v0", wrappers=timed),
    ]
    Gymnasium.check_tasks(tasks)
    learner = FQI(iterations=1, episodes=3, regressor=Forest(trees=2))
    found = run(stages(tasks, learner, Boost()), seeds=[0], progress=False)
    assert list(found.task) == [1, 2]
    lake = Gymnasium("FrozenLake-v1", observation="my_maps.cell")
    assert lake.state_dim == 2 and lake.n_actions == 4


class Scored(Counter):
    """Says in info whether it is a success, which is so in some steps."""

    def step(self, action):
        seen, reward, end, cut, _ = super().step(action)
        return seen, reward, end, cut, {"is_success": np.array([action == 8])}


gymnasium.register("tests/Scored-v0", Scored, max_episode_steps=9)

RULES = {
    "FrozenLake-v1": ({}, "rewarded", lambda r, end, info: end and r[-1] > 0),
    "CliffWalking-v1": ({"horizon": 40}, "absorbed", lambda r, end, info: end),
    "CartPole-v1": ({"horizon": 25}, "survived", lambda r, end, info: not end),
    "Acrobot-v1": ({"success": "unpunished"}, "unpunished", None),
    "Taxi-v4": (
        {"success_threshold": -160, "horizon": 40},
        "threshold",
        lambda r, end, info: sum(r) >= -160,
    ),
    "tests/Scored-v0": ({}, "info", lambda r, end, info: bool(info["is_success"][0])),
}


@pytest.mark.parametrize("name", RULES)
def test_what_is_solved_is_what_a_plain_loop_finds(name):
    changes, rule, expected = RULES[name]
    if name not in gymnasium.registry:
        pytest.skip("of another version of Gymnasium")
    task = Gymnasium(name, **changes)
    assert task.success == rule
    found = played(task, episodes=40)
    solved = found.solved(success_of(task))[0]
    env = gymnasium.make(name, max_episode_steps=task.horizon)
    counted = []
    for lane, number in enumerate(start_states(stream(0, "data", 1), task, 40)[:, 0]):
        env.reset(seed=int(number * 2**31))
        rewards, over = [], False
        while not over:
            action = found.action[0, lane, len(rewards)] + task.first_action
            _, reward, end, cut, info = env.step(int(action))
            rewards.append(reward)
            over = end or cut
        if expected is None:
            counted.append(end and rewards[-1] >= 0)
        else:
            counted.append(expected(rewards, end, info))
    assert solved.tolist() == counted
    if name != "Acrobot-v1" and name != "CliffWalking-v1":
        assert 0 < sum(counted) < 40 or name == "FrozenLake-v1"


@pytest.mark.parametrize(
    ("reports", "low", "high", "registered", "rule"),
    [
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
    ],
)
def test_the_default_rule(reports, low, high, registered, rule):
    assert default(reports, low, high, registered).rule == rule


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("MiniGrid-Empty-5x5-v0", "env.id=minigrid:MiniGrid-Empty-5x5-v0"),
        ("ALE/Pong-v5", "env.id=ale_py:ALE/Pong-v5"),
        ("CartPole", "env.id=CartPole-v1"),
        ("cartpole-v1", "env.id=CartPole-v1"),
        ("MountainCar-v9", "env.id=MountainCar-v0"),
        ("Nothing-like-it-v0", "env.id=module:Name-v0"),
        ("miniworld:MiniWorld-Maze-v0", "pip install miniworld"),
    ],
)
def test_an_id_that_is_not_registered_gets_the_line_to_type(name, line, monkeypatch):
    monkeypatch.delitem(gymnasium.registry, name, raising=False)
    with pytest.raises(ConfigError) as refused:
        Gymnasium(name)
    assert f"env.id={name}: " in str(refused.value) and line in str(refused.value)


def test_trusting_gymnasium_breaks_nothing(monkeypatch):
    monkeypatch.setenv("BCRL_TRUST", "gymnasium,fqi,maze")
    (made,) = plans("env=gymnasium", "env.id=gymnasium:CartPole-v1")
    assert made.target.n_actions == 2
    assert plan("env=maze").target.name == "maze"


def test_wrappers_of_foreign_packages_need_trust():
    for name in ("gymnasium.wrappers.RecordVideo", "gymnasium.utils.play.play"):
        with pytest.raises(ConfigError, match=r"env\.wrappers="):
            Gymnasium(**CAR, wrappers=[{"name": name}])
    box = [{"name": "DiscretizeAction", "bins": [5]}]
    pendulum = Gymnasium("Pendulum-v1", wrappers=box)
    assert pendulum.n_actions == 5 and pendulum.state_dim == 3


@pytest.mark.parametrize(
    ("offset", "scale", "note"),
    [(0.0, 1.0, False), (1.7e9, 1.0, True), (0.0, 1e-8, True), (1e3, 1e-5, True)],
)
def test_a_component_that_float32_does_not_resolve_is_noted(offset, scale, note):
    cells = np.random.default_rng(0).integers(7, size=(200, 1))
    seen = np.hstack([np.cos(cells), offset + scale * cells])
    assert [text.split()[1] for text in coarse(seen)] == ["1"] * note


def test_a_replay_that_ends_elsewhere_fails_its_lane():
    task = Gymnasium("CartPole-v1", horizon=30)
    lanes = task.lanes()
    state = lanes.begin(np.full((3, 1), 0.25))
    lanes.step(state, np.ones(3, int), None)
    lanes.close()
    lanes.seen[1] += 1e-9
    after, *_, cut = lanes.step(state, np.ones(3, int), None)
    assert list(lanes.failures) == [1] and "replay" in lanes.failures[1]
    assert cut.tolist() == [False, True, False] and not after[1].any()
    assert not lanes.restart(np.ones(3, bool), np.full((3, 1), 0.5), after)[1].any()


def test_what_is_flattened_is_said_by_the_wrappers_name():
    (said,) = trial(Gymnasium("FrozenLake-v1")).adapted
    assert "Discrete(16)" in said and "FlattenObservation" in said
    assert trial(Gymnasium("CartPole-v1")).adapted == ()
