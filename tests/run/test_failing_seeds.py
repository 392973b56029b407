"""A seed that fails is named; the results of the others do not change."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from bcrl import api
from bcrl.common.seeding import stream
from bcrl.errors import BcrlError, LostSeeds
from bcrl.evaluation.metrics import Probe
from bcrl.evaluation.step_metrics import StepProbe
from bcrl.learning.dqn import DQN
from bcrl.learning.fqi import FQI
from bcrl.learning.rollout import rollout, starts_and_draws
from bcrl.learning.stage import CurriculumRun, Snapshot, Stage, learn
from bcrl.learning.transfer import Boost, warm_start
from bcrl.q.forest.estimator import ExtraTrees
from bcrl.q.functions import Table, query
from bcrl.q.regressors.base import Fit, Fitted, FittedQ, Problem
from bcrl.q.regressors.ours import ForestRegressor, Tabular
from bcrl.q.regressors.scikit import Sklearn
from bcrl.run import runner
from tests.conftest import plan
from tests.run.runs import FQI as SMALL
from tests.run.runs import about, run
from tests.run.runs import rows as recorded
from tests.toys import Corridor, OpenCorridor, Simulated, staged, team

BAD = 1  # the seed that fails


@dataclass(frozen=True)
class Sick:
    """Tables or forests that go wrong for one seed, in one way."""

    way: str
    inner: object
    at: int = 2  # the iteration

    @property
    def finite_only(self):
        return self.inner.finite_only

    def fit(self, problems, keep, threads):
        fits = self.inner.fit(problems, keep, threads)
        for i, (problem, fit) in enumerate(zip(problems, fits, strict=True)):
            if problem.seed == BAD and problem.path[1] >= self.at:
                fits[i] = self._spoilt(fit)
        return fits

    def _spoilt(self, fit):
        if self.way == "raises":
            raise RuntimeError("a broken\npart")
        if self.way == "memory":
            raise MemoryError
        if self.way == "shape":
            return replace(fit, fitted=fit.fitted[:, None])
        if self.way == "predict":
            return replace(fit, model="lost")
        return replace(
            fit, fitted=fit.fitted * {"nan": np.nan, "inf": np.inf}[self.way]
        )

    def predict(self, models, x, threads):
        if "lost" in models:
            raise KeyError("lost model")
        return self.inner.predict(models, x, threads)


def course(env, regressor, seeds, *transfers, iterations=4):
    """Snapshots of two stages, and what a probe measures."""
    learner = FQI(iterations, 5, regressor)
    stages = [
        Stage(n, n, env, learner, transfers, (n - 1) * iterations) for n in (1, 2)
    ]
    probe = Probe(seeds, [env], ["return", "solved", "residual_start"])
    for now in learn(stages, replace(team(*seeds), probe=probe.states)):
        yield now, probe.measure(now), dict(probe.failed)


FOREST = ForestRegressor(trees=3)
WAYS = [
    *((Corridor(), Sick(way, Tabular())) for way in ("nan", "inf", "raises", "memory")),
    *((OpenCorridor(), Sick(way, FOREST)) for way in ("nan", "shape", "raises")),
    (OpenCorridor(), Sick("predict", FOREST)),
]


@pytest.mark.parametrize(("env", "sick"), WAYS)
@pytest.mark.parametrize("transfers", [(Boost(),), (warm_start,)])
def test_a_regressor_that_fails_one_seed_fails_that_seed_alone(env, sick, transfers):
    some = list(course(env, sick, (0, BAD, 2), *transfers))
    without = list(course(env, sick.inner, (0, 2), *transfers))
    for (now, rows, _), (other, expected, healthy) in zip(some, without, strict=True):
        assert [rows[0], rows[2]] == expected and not healthy
        for here, there in ((0, 0), (2, 1)):
            assert np.array_equal(now.probed_q[here], other.probed_q[there])
    failed = [known for *_, known in some]
    later = {1} if sick.way == "predict" else set()  # the second stage starts with it
    expected = [set(), {1}, {1}, {1}, later, {1}, {1}, {1}]
    assert [set(known) for known in failed] == expected
    reasons = [now.failed for now, *_ in some]
    if sick.way != "predict":  # known to the measurement only
        assert [bool(x) for x in reasons[:4]] == [False, True, True, True]
        assert set(reasons[3]) == {1} and np.isfinite(some[3][0].probed_q[1]).all()
    why = failed[-1][1]
    assert why.startswith("algorithm.regressor=Sick(") and "\n" not in why
    words = {"raises": "RuntimeError: a broken part", "memory": "memory"}
    words |= {"shape": "1), expected (", "predict": "KeyError"}
    assert words.get(sick.way, "finite") in why
    if sick.way in ("raises", "memory", "predict"):
        assert "test_failing_seeds.py:" in why  # where in the user's code


def test_a_table_that_is_not_finite_is_walked_safely_and_named():
    env = Corridor()
    good = np.random.default_rng(0).random((6, 2))
    tables = [good, np.full((6, 2), np.nan), np.where(good > 0.5, np.inf, good)]
    rngs = [stream(seed, "data") for seed in range(3)]
    start, u = starts_and_draws(rngs, env, 4)
    played = rollout(env, Table(tables, env), start, u)
    assert set(played.failed) == {1, 2}
    alone = rollout(env, Table([good], env), start[:1], u[:1])
    assert np.array_equal(played.state[0], alone.state[0]) and not alone.failed


def test_an_index_outside_of_the_states_is_refused():
    @dataclass(frozen=True)
    class Beyond(Corridor):
        def index(self, state):
            return super().index(state) + 3

    for env, state in ((Beyond(), 4.0), (Corridor(), -7.0)):
        with pytest.raises(BcrlError, match="index"):
            Table([np.zeros((6, 2))], env)(np.full((1, 1, 1), state), 2)
    u = np.zeros((1, 30, 1, 2))
    with pytest.raises(BcrlError, match="index"):
        rollout(Beyond(), Table([np.zeros((6, 2))], Beyond()), np.zeros((1, 1, 1)), u)


def test_seeds_that_fail_are_left_out_when_q_is_evaluated():
    def q(states, n_actions):
        for seed in (0, 2):
            if len(states[seed]):
                raise LostSeeds({seed: f"seed {seed}"})
        return [np.ones((len(x), n_actions)) for x in states]

    values, failed = query(q, np.zeros((4, 5, 1)), 2)
    assert failed == {0: "seed 0", 2: "seed 2"}
    assert [v.mean() for v in values] == [0, 1, 0, 1] and values[0].shape == (5, 2)

    def always(states, n_actions):
        raise LostSeeds({0: "again"})

    with pytest.raises(LostSeeds, match="again"):
        query(always, np.zeros((1, 1, 1)), 2)


def test_a_model_that_predicts_too_little_is_named():
    class Short:
        finite_only = False

        def predict(self, models, x, threads):
            return [np.zeros(len(each) - 1) for each in x]

    x = np.zeros((3, 1), np.float32)
    problem = Problem(x, np.zeros(3), np.ones(3, int), x, 0, (1, 1, 0))
    model = Fitted.of(problem, Fit(object(), *np.zeros((2, 3))))
    with pytest.raises(LostSeeds, match=r"predict.*\(2,\).*\(3,\)"):
        FittedQ([[model]], Short(), team(0))([x], 1)


def test_a_regressor_without_enough_rows_ends_in_one_sentence():
    learner = FQI(2, 3, Sklearn("KNeighborsRegressor", {"n_neighbors": 5000}))
    with pytest.raises(BcrlError, match=r"n_neighbors.*5000") as told:
        api.run(api.stages([api.CarOnHill()], learner), seeds=[4], progress=False)
    assert "iteration 1" in str(told.value) and "seed 4" in str(told.value)


@dataclass(frozen=True)
class SickForest(ForestRegressor):
    """A user's regressor that can't fit seed 1."""

    def fit(self, problems, keep, threads):
        if any(p.seed == BAD and p.path[:2] == (1, 2) for p in problems):
            raise ZeroDivisionError("by nothing")
        return super().fit(problems, keep, threads)


def test_files_and_exit_code_of_a_seed_that_failed(tmp_path, monkeypatch):
    monkeypatch.setenv("BCRL_TRUST", "tests")
    small = ("env=maze", *SMALL, "seeds.count=3", "tag=t")
    mine = f"algorithm.regressor.name={__name__}.SickForest"
    p = plan(*small, mine, f"runs_dir={tmp_path / 'sick'}")
    with pytest.raises(BcrlError) as told:
        runner.run(p)
    assert told.value.exit_code == 1 and "seed 1" in str(told.value)
    well = run(tmp_path / "well", *small)
    for seed in (0, 2):
        assert about(p, seed)["status"] == "complete"
        assert recorded(p, seed) == recorded(well, seed)
    status, found = about(p, BAD)["status"], recorded(p, BAD)
    assert status.startswith("failed: algorithm.regressor=SickForest")
    assert "ZeroDivisionError" in status
    assert found[:-1] == recorded(well, BAD)[: len(found) - 1] and len(found) == 2
    assert np.isnan(list(found[-1].values())[3:]).all()  # missing: empty cells


# --- simulators ---


def numbers(seed, purpose, *path, episodes):
    """What resets the episodes of a seed and a purpose."""
    rngs = [stream(seed, purpose, *path)]
    return tuple(starts_and_draws(rngs, Simulated(), episodes)[0].ravel().tolist())


def test_episodes_name_the_seeds_whose_simulators_failed():
    env = replace(Simulated(), doomed=numbers(1, "data", 1, episodes=3)[1:2])
    rngs = [stream(seed, "data", 1) for seed in (0, 1, 2)]
    start, u = starts_and_draws(rngs, env, 3)
    q = Table([np.zeros((6, 2))] * 3, env)
    some, other = (rollout(e, q, start, u) for e in (env, Simulated()))
    assert some.failed == {1: "step failed: it broke"} and not other.failed
    assert some.length[1, 1] == 1
    for part in ("state", "action", "reward", "absorbing", "length"):
        ours, theirs = getattr(some, part), getattr(other, part)
        assert np.array_equal(ours[[0, 2]], theirs[[0, 2]])


@pytest.mark.parametrize("where", ["data", "evaluation"])
def test_a_simulator_that_fails_fails_its_seed_in_fqi(where):
    path = (1,) if where == "data" else (2,)  # the second evaluation
    doomed = numbers(BAD, where, *path, episodes=4)[:1]
    some = list(course(replace(Simulated(), doomed=doomed), FOREST, (0, 1, 2), Boost()))
    well = list(course(Simulated(), FOREST, (0, 1, 2), Boost()))
    for (now, rows, failed), (other, expected, _) in zip(some, well, strict=True):
        assert [rows[0], rows[2]] == [expected[0], expected[2]]
        assert np.array_equal(now.probed_q[2], other.probed_q[2])
        due = now.stage.number == 1 if where == "data" else now.count == 2
        assert set(failed) == ({1} if due else set())
        if due:
            assert "it broke" in failed[1]
            assert all(np.isnan(value) for value in rows[1].values())


@pytest.mark.parametrize("where", ["acting", "evaluation"])
def test_a_simulator_that_fails_fails_its_seed_in_dqn(where):
    settings = DQN(40, 20, 10, batch_size=8, replay_size=50, hidden=(8,))
    settings = replace(settings, evaluate_every=10, evaluation_episodes=2)
    number = stream(BAD, "exploration", 1).random(1)
    evaluated = numbers(BAD, "evaluation", 1, 30, episodes=2)[1:]
    doomed = tuple(number.tolist()) if where == "acting" else evaluated

    def run(env):
        probe = StepProbe((0, 1, 2), [env])
        for now in learn([staged(settings, env)], team(0, 1, 2)):
            rows = probe.measure(now)
            yield now.count, rows, dict(probe.failed)

    for (count, rows, failed), (_, expected, _) in zip(
        run(replace(Simulated(), doomed=doomed)), run(Simulated()), strict=True
    ):
        assert [rows[0], rows[2]] == [expected[0], expected[2]]
        due = where == "acting" or count == 30
        assert set(failed) == ({1} if due else set())
        if where == "evaluation" and due:
            assert np.isnan([rows[1]["return"], rows[1]["q_mean"]]).all()


# --- learners that keep no contract ---


class Silent:
    """A learner that yields nothing, or no last snapshot."""

    name, length = "silent", 1

    def __init__(self, *moments):
        self.moments = moments

    def learn(self, stage, start, team, state=None):
        yield from self.moments


def test_a_learner_that_yields_no_last_snapshot_is_named():
    early = Snapshot(staged(Silent(), Corridor()), 0, None, None)
    for moments in ((), (early,)):
        stages = [staged(DQN(), Corridor()), staged(Silent(*moments), Corridor(), 2)]
        for some in (stages[1:], stages[1:] * 2):
            with pytest.raises(BcrlError, match=r"silent.*last_of_stage"):
                list(CurriculumRun(some, team(0)))


@dataclass(frozen=True)
class Rude(ForestRegressor):
    """Changes whatever it is given, after it has used it."""

    def fit(self, problems, keep, threads):
        fits = super().fit(problems, keep, threads)
        for problem in problems:
            for array in (problem.x, problem.y, problem.multiplicity, problem.queries):
                array[:] = 9
        return fits

    def predict(self, models, x, threads):
        found = super().predict(models, x, threads)
        for array in x:
            array[:] = 9
        return found


def test_a_regressor_may_change_what_it_is_given():
    some = course(OpenCorridor(), Rude(trees=3), (0, 1), Boost())
    for (_, rows, _), (_, expected, _) in zip(
        some, course(OpenCorridor(), FOREST, (0, 1), Boost()), strict=True
    ):
        assert rows == expected


def test_estimators_that_are_not_scikit_learns_own_are_regressors():
    learner = FQI(2, 3, Sklearn(ExtraTrees(3)))
    assert len(api.run(api.stages([OpenCorridor()], learner), [0], progress=False)) == 2
