"""A seed that fails is named; the results of the others do not change."""

import re
from dataclasses import dataclass, replace

import numpy as np
import pytest

from bcrl import api
from bcrl.common.seeding import stream
from bcrl.errors import BcrlError
from bcrl.evaluation.metrics import Probe
from bcrl.evaluation.step_metrics import StepProbe
from bcrl.learning.dqn import DQN
from bcrl.learning.fqi import FQI
from bcrl.learning.rollout import starts_and_draws
from bcrl.learning.stage import Stage, learn
from bcrl.learning.transfer import Boost, warm_start
from bcrl.q.functions import Table
from bcrl.q.regressors.ours import ForestRegressor, Tabular
from bcrl.q.regressors.scikit import Sklearn
from bcrl.run import runner
from tests.conftest import plan
from tests.run import runs
from tests.toys import Corridor, OpenCorridor, Simulated, staged, team

BAD = 1  # the seed that fails
FOREST = ForestRegressor(trees=3)


class Sick:
    """Goes wrong for one seed, in one way, from iteration 2 on."""

    def fit(self, problems, keep, threads):
        fits = super().fit(problems, keep, threads)
        for i, (problem, fit) in enumerate(zip(problems, fits, strict=True)):
            if problem.seed == BAD and problem.path[1] >= 2:
                fits[i] = self._spoilt(fit)
        return fits

    def _spoilt(self, fit):
        if self.way == "raises":
            raise RuntimeError("a broken\npart")
        if self.way == "memory":
            raise MemoryError
        if self.way == "shape":
            return replace(fit, fitted=fit.fitted[:, None])
        if self.way in ("lost", "short"):
            return replace(fit, model=self.way)
        return replace(fit, fitted=fit.fitted * float(self.way))

    def predict(self, models, x, threads):
        if "lost" in models:
            raise KeyError("lost model")
        if "short" in models:
            return [each[:-1, 0] for each in x]
        return super().predict(models, x, threads)


@dataclass(frozen=True)
class SickTable(Sick, Tabular):
    way: str = "nan"


@dataclass(frozen=True)
class SickForest(Sick, ForestRegressor):
    way: str = "raises"


def course(env, regressor, seeds, *transfers):
    """Snapshots of two stages, and what a probe measures."""
    learner = FQI(4, 5, regressor)
    stages = [Stage(n, n, env, learner, transfers, 4 * n - 4) for n in (1, 2)]
    probe = Probe(seeds, [env], ["return", "solved", "residual_start"])
    for now in learn(stages, replace(team(*seeds), probe=probe.states)):
        yield now, probe.measure(now), dict(probe.failed)


#: How it goes wrong → a part of the reason.
WAYS = {"nan": "finite", "inf": "finite", "memory": "memory", "lost": "KeyError"}
WAYS |= {"raises": "RuntimeError: a broken part", "shape": "1), expected ("}
WAYS |= {"short": "predict"}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("transfer", [Boost(), warm_start])
def test_a_regressor_that_fails_one_seed_fails_that_seed_alone(way, transfer):
    env, inner, sick = OpenCorridor(), FOREST, SickForest(trees=3, way=way)
    if way in ("nan", "memory"):
        env, inner, sick = Corridor(), Tabular(), SickTable(way)
    some = list(course(env, sick, (0, BAD, 2), transfer))
    without = list(course(env, inner, (0, 2), transfer))
    for (now, rows, _), (other, expected, healthy) in zip(some, without, strict=True):
        assert [rows[0], rows[2]] == expected and not healthy
        kept = [now.probed_q[seed] for seed in (0, 2)]
        assert np.array_equal(kept, other.probed_q)
    later = {1} if way in ("lost", "short") else set()  # the next stage's base
    expected = [set(), {1}, {1}, {1}, later, {1}, {1}, {1}]
    assert [set(known) for *_, known in some] == expected
    why = some[-1][-1][1]
    assert why.startswith("algorithm.regressor=Sick") and "\n" not in why
    assert WAYS[way] in why
    if way in ("raises", "memory", "lost"):
        assert "test_failing_seeds.py:" in why  # where in the user's code


@pytest.mark.parametrize("state", [-1.0, 6.0])
def test_an_index_outside_of_the_states_is_rejected(state):
    with pytest.raises(BcrlError, match="index"):
        Table([np.zeros((6, 2))], Corridor())(np.full((1, 1, 1), state), 2)


def test_a_regressor_without_enough_rows_ends_in_one_sentence():
    learner = FQI(2, 3, Sklearn("KNeighborsRegressor", {"n_neighbors": 5000}))
    with pytest.raises(BcrlError, match=r"n_neighbors.*5000") as told:
        api.run(api.stages([api.CarOnHill()], learner), seeds=[4], progress=False)
    assert "iteration 1" in str(told.value) and "seed 4" in str(told.value)


def test_files_and_exit_code_of_a_seed_that_failed(tmp_path, monkeypatch):
    monkeypatch.setenv("BCRL_TRUST", "tests")
    small = ("env=maze", *runs.FQI, "seeds.count=3", "tag=t")
    mine = f"algorithm.regressor.name={__name__}.SickForest"
    p = plan(*small, mine, f"runs_dir={tmp_path / 'sick'}")
    with pytest.raises(BcrlError, match="seed 1") as told:
        runner.run(p)
    assert told.value.exit_code == 1
    well = runs.run(tmp_path / "well", *small)
    for seed in (0, 2):
        assert runs.about(p, seed)["status"] == "complete"
        assert runs.rows(p, seed) == runs.rows(well, seed)
    status, found = runs.about(p, BAD)["status"], runs.rows(p, BAD)
    assert re.match("failed: algorithm.regressor=SickForest.*RuntimeError", status)
    assert len(found) == 2 and found[0] == runs.rows(well, BAD)[0]
    assert np.isnan(list(found[-1].values())[3:]).all()  # missing: empty cells


def fqi(env):
    for now, *rest in course(env, FOREST, (0, 1, 2), Boost()):
        yield now.count, now.stage.number, *rest


def dqn(env):
    settings = DQN(40, 20, 10, batch_size=8, replay_size=50, hidden=(8,))
    settings = replace(settings, evaluate_every=10, evaluation_episodes=2)
    probe = StepProbe((0, 1, 2), [env])
    for now in learn([staged(settings, env)], team(0, 1, 2)):
        yield now.count, 1, probe.measure(now), dict(probe.failed)


#: A learner, what resets an episode that fails, and when the seed has failed.
DOOMED = {
    "FQI's data": (fqi, ("data", 1), lambda count, stage: stage == 1),
    "FQI's evaluation": (fqi, ("evaluation", 2), lambda count, stage: count == 2),
    "DQN's acting": (dqn, ("exploration", 1), lambda count, stage: True),
    "DQN's evaluation": (dqn, ("evaluation", 1, 30), lambda count, stage: count == 30),
}


@pytest.mark.parametrize("where", DOOMED)
def test_a_simulator_that_fails_fails_its_seed(where):
    run, path, is_due = DOOMED[where]
    starts, _ = starts_and_draws([stream(BAD, *path)], Simulated(), 1)
    doomed = replace(Simulated(), doomed=tuple(starts.ravel().tolist()))
    some, well = run(doomed), run(Simulated())
    for (*now, rows, failed), (*_, expected, _) in zip(some, well, strict=True):
        assert [rows[0], rows[2]] == [expected[0], expected[2]]
        assert set(failed) == ({1} if is_due(*now) else set())
        assert all("it broke" in why for why in failed.values())
        if failed and run is fqi:
            assert all(np.isnan(value) for value in rows[1].values())
