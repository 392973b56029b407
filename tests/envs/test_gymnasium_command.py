"""Gymnasium's environments in the command: accepted values, rejected values, ids."""

import gymnasium
import pytest

from bcrl.api import Gymnasium
from bcrl.errors import BcrlError, ConfigError
from tests.conftest import plan, plans
from tests.envs.counter import COUNTER, ENDLESS


@pytest.mark.parametrize("env", ["mountain_car", "cart_pole", "acrobot"])
def test_shipped_curricula_apply_their_parameters(env):
    for task in plan(f"env={env}").tasks:
        there = task.make().unwrapped
        assert {key: getattr(there, key) for key in task.attributes} == task.attributes
        if env == "cart_pole":
            assert there.polemass_length == pytest.approx(there.masspole * there.length)


def test_an_id_of_the_command_names_the_folder():
    asked = ("env=gymnasium", f"env.id={COUNTER}")
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
    f"env.id={ENDLESS}": "env.horizon",
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
        given.append(f"env.id={COUNTER}")
    with pytest.raises(BcrlError) as error:
        plans("env=gymnasium", *given)
    assert BAD[overrides] in str(error.value)


def test_residual_policies_need_action_vectors():
    given = ("env=mountain_car", "algorithm=dqn", "env.action_vectors=null")
    with pytest.raises(BcrlError, match=r"env\.action_vectors"):
        plans(*given, "curriculum=on", "transfer=residual_policy")


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
    assert plan("env=gymnasium", "env.id=gymnasium:CartPole-v1").target.n_actions == 2
    assert plan("env=maze").target.name == "maze"
