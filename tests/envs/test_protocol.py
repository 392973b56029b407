"""Errors in a user's environment or script are named before any work."""

import sys
from dataclasses import dataclass

import numpy as np
import pytest

from bcrl.api import FQI, Boost, Forest, ResidualPolicy, Tabular, run, stages
from bcrl.errors import ConfigError
from tests.toys import OpenCorridor

LEARNER = FQI(iterations=1, episodes=2, regressor=Forest(trees=2))


def variant(**changes) -> OpenCorridor:
    """The corridor with functions or numbers changed."""
    return dataclass(frozen=True)(type("Mine", (OpenCorridor,), changes))()


def step(self, state, action, noise=None, change=lambda *x: x):
    return change(*OpenCorridor.step(self, state, action))


def changed(change):
    return {"step": lambda *a: step(*a, change=change)}


DICE, BUFFER = iter(range(1000)), {}
#: The change, and words of the message.
WRONG = {
    "other states": ({"state_dim": 2}, r"initial: states have shape \(16, 4, 1\)"),
    "no number": ({"initial_noise": None}, "initial_noise is None"),
    "rewards with an axis": (
        changed(lambda s, r, a: (s, r[..., None], a)),
        r"rewards have shape \(16, 4, 1\), expected \(16, 4\)",
    ),
    "no booleans": (changed(lambda s, r, a: (s, r, {})), "absorbing have shape None"),
    "floats as ends": (changed(lambda s, r, a: (s, r, 1.0 * a)), "must be booleans"),
    "two values": (changed(lambda s, r, a: (s, r)), "2 values"),
    "no reward": (changed(lambda s, r, a: (s, r * np.nan, a)), "finite"),
    "dice": (changed(lambda s, r, a: (s, r + next(DICE), a)), "comes in as noise"),
    "late dice": (
        changed(lambda s, r, a: (s, r + (s[..., 0] == 4) * next(DICE), a)),
        "comes in as noise",
    ),
    "an exception": ({"step": lambda *_: 1 / 0}, "step failed: ZeroDivisionError"),
    "an exit": ({"step": lambda *_: sys.exit(3)}, "SystemExit: 3"),
    "noise changed in place": (
        {"initial": lambda self, noise: np.add(noise, 1, out=noise)},
        "changes its arguments",
    ),
    "states that grow without bound": (
        changed(lambda s, r, a: (np.where(s == 4, 1e39, s), r, a)),
        "step: states .*float32",
    ),
    "one buffer": (
        changed(lambda s, r, a: (BUFFER.setdefault(s.shape, s), r, a)),
        "one array again and again",
    ),
    "no threshold": ({"success": "threshold"}, "success_threshold is None"),
    "an unknown rule": ({"success": "info"}, "success=info"),
    "no hash": ({"__hash__": lambda self: hash([])}, "tuple.*list"),
    "no start": (
        {"evaluation_states": lambda self: np.zeros((0, 1))},
        "evaluation_states: states have shape",
    ),
    "nothing for a start": ({"evaluation_states": lambda self: None}, "shape None"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_broken_contract_is_named(name):
    changes, words = WRONG[name]
    with pytest.raises(ConfigError, match=words):
        stages([variant(**changes)], LEARNER)


def test_an_environment_that_is_right_passes():
    found = run(stages([variant()] * 2, LEARNER, Boost()), [0], progress=False)
    assert list(found.stage) == [1, 2]


def test_a_parameter_has_to_have_an_effect():
    step = {"step": lambda self, *given: OpenCorridor(1.0).step(*given)}
    ignored = dataclass(frozen=True)(type("Mine", (OpenCorridor,), step))
    with pytest.raises(ConfigError, match="behave alike"):
        stages([ignored(prize=1.0), ignored(prize=2.0)], LEARNER)
    ignored.verify = False
    assert len(stages([ignored(prize=1.0), ignored(prize=2.0)], LEARNER)) == 2


@pytest.mark.parametrize(
    ("tasks", "learner", "transfers", "words"),
    [
        ([], LEARNER, (), "0 tasks"),
        ([OpenCorridor()], [LEARNER] * 2, (), "there are 2 learners"),
        ([OpenCorridor()], LEARNER, (Boost,), r"write Boost\(\)"),
        ([OpenCorridor()], LEARNER, (ResidualPolicy(),), "one task"),
        ([OpenCorridor()], FQI(1, 1, Tabular), (), "is no regressor"),
        ([OpenCorridor()], "FQI", (), "learners"),
    ],
)
def test_stages_refuses_what_makes_no_sense(tasks, learner, transfers, words):
    with pytest.raises(ConfigError, match=words):
        stages(tasks, learner, *transfers)


@pytest.mark.parametrize("seeds", [3, [], [0, 0], [-1], np.int64(3), [0.5]])
def test_seeds_are_different_numbers(seeds):
    with pytest.raises(ConfigError, match="seeds"):
        run(stages([OpenCorridor()], LEARNER), seeds, progress=False)


def test_an_estimator_of_scikit_learn_is_to_be_wrapped():
    from sklearn.neighbors import KNeighborsRegressor

    bare = FQI(iterations=1, episodes=1, regressor=KNeighborsRegressor())
    with pytest.raises(ConfigError, match=r"Sklearn\(estimator\)"):
        stages([OpenCorridor()], bare)


@pytest.mark.parametrize("values", [{"horizon": 0}, {"horizon": 3.0}, {"gamma": 1.0}])
def test_horizon_and_discount_are_checked(values):
    with pytest.raises(ConfigError, match=next(iter(values))):
        stages([OpenCorridor(**values)], LEARNER)


def test_scripts_may_count_in_numpys_integers_and_in_generators():
    learner = FQI(np.int64(1), np.int64(2), Forest(trees=2))
    plain = run(stages([OpenCorridor()], LEARNER), [0], progress=False)
    asked = (name for name in ("return", "solved"))
    made = stages((env for env in [OpenCorridor()]), (x for x in [learner]))
    found = run(made, np.arange(1), asked, progress=False)
    assert found.equals(plain)


@pytest.mark.parametrize("tasks", ["maze", [OpenCorridor], [None]])
def test_what_is_no_environment_is_named(tasks):
    with pytest.raises(ConfigError, match="tasks="):
        stages(tasks, LEARNER)
    with pytest.raises(ConfigError, match="None: is no learner"):
        stages([OpenCorridor()], None)
