"""What holds for all our environments; a user's errors are named before any work."""

import sys
from dataclasses import dataclass, replace

import numpy as np
import pytest
from sklearn.neighbors import KNeighborsRegressor

from bcrl.api import FQI, Boost, Forest, ResidualPolicy, Tabular, run, stages
from bcrl.envs.car_on_hill import CarOnHill
from bcrl.envs.linear_system import LinearSystem
from bcrl.envs.maze import Maze
from bcrl.errors import ConfigError
from tests.toys import OpenCorridor

LEARNER = FQI(iterations=1, episodes=2, regressor=Forest(trees=2))


def variant(**changes) -> OpenCorridor:
    """The corridor with functions or numbers changed."""
    return dataclass(frozen=True)(type("Mine", (OpenCorridor,), changes))()


def changed(change):
    """Another answer of `step`."""
    return {"step": lambda self, s, a, _: change(*OpenCorridor.step(self, s, a))}


DICE, BUFFER = iter(range(1000)), {}
#: Words of the message, and the change.
WRONG = {
    r"initial: states .* \(16, 4, 1\)": {"state_dim": 2},
    "initial_noise is None": {"initial_noise": None},
    r"\(16, 4, 1\) .* \(16, 4\)": changed(lambda s, r, a: (s, r[..., None], a)),
    "absorbing have shape None": changed(lambda s, r, a: (s, r, {})),
    "float64, expected booleans": changed(lambda s, r, a: (s, r, 1.0 * a)),
    "env.name=corridor: step gives 2 values": changed(lambda s, r, a: (s, r)),
    "rewards must be finite": changed(lambda s, r, a: (s, r * np.nan, a)),
    "other rewards": changed(lambda s, r, a: (s, r + next(DICE), a)),
    "noise": changed(lambda s, r, a: (s, r + (s[..., 0] == 4) * next(DICE), a)),
    "ZeroDivisionError": {"step": lambda *_: 1 / 0},
    "SystemExit: 3": {"step": lambda *_: sys.exit(3)},
    "its arguments": {"initial": lambda self, noise: np.add(noise, 1, out=noise)},
    "step: .*float32": changed(lambda s, r, a: (np.where(s == 4, 1e39, s), r, a)),
    "one array": changed(lambda s, r, a: (BUFFER.setdefault(s.shape, s), r, a)),
    "success_threshold is None": {"success": "threshold"},
    "success=info": {"success": "info"},
    "tuple.*list": {"__hash__": lambda self: hash([])},
    "there are no states": {"evaluation_states": lambda self: np.zeros((0, 1))},
    "shape None": {"evaluation_states": lambda self: None},
}


@pytest.mark.parametrize("words", WRONG)
def test_a_broken_contract_is_named(words):
    with pytest.raises(ConfigError, match=words):
        stages([variant(**WRONG[words])], LEARNER)


@pytest.mark.parametrize(
    "env", [CarOnHill(1.2), Maze(0.55), LinearSystem(), LinearSystem("lq")], ids=repr
)
def test_a_batch_steps_as_its_lanes_do(env):
    rng = np.random.default_rng(0)
    state = env.initial(rng.random((6, 7, env.initial_noise)))
    for _ in range(20):
        action = rng.integers(env.n_actions, size=(6, 7))
        given = state, action, rng.random((6, 7, env.step_noise))
        together = env.step(*given)
        for lane in np.ndindex(6, 7):
            alone = env.step(*(x[lane] for x in given))
            for many, one in zip(together, alone, strict=True):
                assert many[lane].tobytes() == one.tobytes()
        each = np.arange(env.n_actions)  # of every action at each state
        spread = env.step(state[..., None, :], each, given[2][..., None, :])
        for many, one in zip(spread, together, strict=True):
            chosen = [many[lane][action[lane]] for lane in np.ndindex(6, 7)]
            assert np.array_equal(chosen, one.reshape(42, *one.shape[2:]))
        state = together[0]


IMPOSSIBLE = {
    CarOnHill: {"mass": (0.0, np.nan, np.inf), "gamma": (1.0,), "horizon": (0,)},
    Maze: {"height": (1.0,), "preset": ("relesed",)},
    LinearSystem: {"task": ("lqr",), "preset": ("relesed",), "gamma": (-0.1, np.nan)},
}


@pytest.mark.parametrize("cls", IMPOSSIBLE)
def test_impossible_constants_are_rejected_by_name(cls):
    for key, values in IMPOSSIBLE[cls].items():
        for bad in values:
            with pytest.raises(ConfigError, match=rf"env\.{key}={bad}"):
                cls(**{key: bad})


def test_a_parameter_has_to_have_an_effect():
    step = {"step": lambda self, *given: OpenCorridor(1.0).step(*given)}
    ignored = dataclass(frozen=True)(type("Mine", (OpenCorridor,), step))
    tasks = [ignored(prize=1.0), ignored(prize=2.0)]
    with pytest.raises(ConfigError, match="behave alike"):
        stages(tasks, LEARNER)
    ignored.verify = False
    assert len(stages(tasks, LEARNER)) == 2


HERE = [OpenCorridor()]
SENSELESS = {
    "0 tasks": ([], LEARNER),
    "there are 2 learners": (HERE, [LEARNER] * 2),
    r"or Boost\(\)": (HERE, LEARNER, Boost),
    "one task": (HERE, LEARNER, ResidualPolicy()),
    "is no regressor": (HERE, FQI(1, 1, Tabular)),
    r"Sklearn\(estimator\)": (HERE, FQI(1, 1, KNeighborsRegressor())),
    "learners": (HERE, "FQI"),
    "None: is no learner": (HERE, None),
    "tasks=m: ": ("maze", LEARNER),
    "tasks=<class": ([OpenCorridor], LEARNER),
    "tasks=None": ([None], LEARNER),
    "env.horizon=0": ([OpenCorridor(horizon=0)], LEARNER),
    "env.horizon=3.0": ([OpenCorridor(horizon=3.0)], LEARNER),
    "env.gamma=1.0": ([OpenCorridor(gamma=1.0)], LEARNER),
}


@pytest.mark.parametrize("words", SENSELESS)
def test_stages_refuses_what_makes_no_sense(words):
    with pytest.raises(ConfigError, match=words):
        stages(*SENSELESS[words])


@pytest.mark.parametrize("seeds", [3, [], [0, 0], [-1], np.int64(3), [0.5]])
def test_seeds_are_different_numbers(seeds):
    with pytest.raises(ConfigError, match="seeds"):
        run(stages(HERE, LEARNER), seeds, progress=False)


def test_scripts_may_count_in_numpys_integers_and_in_generators():
    learner = FQI(np.int64(1), np.int64(2), Forest(trees=2))
    plain = run(stages(HERE, LEARNER), [0], progress=False)
    made = stages(iter(HERE), iter([learner]))
    found = run(made, np.arange(1), iter(["return", "solved"]), progress=False)
    assert found.equals(plain)


def test_seldom_evaluation_leaves_fqi_unchanged():
    tasks, learners = [*HERE, OpenCorridor(2.0)], [FQI(5, 2, Forest(trees=2))]
    learners.append(replace(learners[0], evaluate_every=2))
    often, seldom = (run(stages(tasks, learner), [0]) for learner in learners)
    assert seldom.iteration.tolist() == [2, 4, 5, 7, 9, 10]
    same = often[often.iteration.isin(seldom.iteration)].reset_index(drop=True)
    assert seldom.pop("learner.evaluate_every").eq(2).all() and seldom.equals(same)
