"""The suite of misleading curricula: its chain at a tiny scale, measures, verdicts."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from bcrl.api import DQN, Maze, stages
from research import misleading, misleading_runs
from research.altered import Hill, Lattice, MountainCar, PointMass
from research.line_search import no_worse
from research.misleading_measures import Scale, kept_gain, measure, scale_of, verdict
from research.misleading_tasks import METHODS, ONLY, SETTINGS, smoke


@pytest.mark.parametrize("env", SETTINGS)
def test_every_job_has_the_same_budget(env):
    for job in misleading_runs.jobs_of(env, SETTINGS[env], range(2)):
        tasks, learners = zip(*job.slots, strict=True)
        if isinstance(learners[-1], DQN):  # random steps depend on the transfers
            course = stages(tasks, learners, *METHODS[job.method])
            learners = [stage.learner for stage in course]
        assert sum(x.length for x in learners) == SETTINGS[env].total, job


def test_altered_steps_have_altered_rewards_actions_and_goals():
    rng, action = np.random.default_rng(0), np.array([0, 1, 2, 3])
    state = Maze().states()[rng.integers(441, size=4)]
    after, reward, over = Maze(height=0.25).step(state, action)
    other = Lattice(height=0.25, order=(1, 0, 3, 2), scale=100.0, shift=2.0)
    found = other.step(state, np.array([1, 0, 3, 2]))
    np.testing.assert_array_equal(found[0], after)
    np.testing.assert_allclose(found[1], 100.0 * reward + 2.0)
    np.testing.assert_array_equal(found[2], over)
    _, reward, over = Lattice(goal=(0.05, 0.95)).step(np.array([0.0, 0.9]), action[3])
    assert (reward, over) == (5.0, True)
    left, right = np.array([-0.99, -1.5]), np.array([0.99, 1.5])
    for goal_left in (False, True):
        hill = Hill(goal_left=goal_left)
        ends = [float(hill.step(p, np.array(a))[1]) for a, p in ((0, left), (1, right))]
        assert ends == ([1.0, -1.0] if goal_left else [-1.0, 1.0])
    _, reward, over = PointMass(goal=(-4.0, 0.0)).step(
        np.array([-4.0, 0, 0, 0]), np.array(0), np.full(8, 0.5)
    )
    assert (reward, over) == (0.0, True)


def test_the_mountain_car_is_gymnasiums():
    gymnasium = pytest.importorskip("gymnasium")
    env = gymnasium.make("MountainCar-v0").unwrapped
    env.reset(seed=3)
    env.force, task = 0.003, MountainCar(force=0.003)
    state = task._observed(np.array(env.state))
    for action in np.random.default_rng(0).integers(3, size=100):
        _, reward, over, *_ = env.step(action)
        state, own, absorbing = task.step(state, np.array(action))
        np.testing.assert_allclose(
            state, task._observed(np.array(env.state)), atol=1e-9
        )
        assert (own, absorbing) == (reward, over)


def test_the_chain_runs_resumes_and_writes(tmp_path, monkeypatch):
    whole = smoke(SETTINGS["hill"])
    sources = {"goal moved": whole.sources["goal moved"]}
    tiny = replace(whole, sources=sources, matrix=())
    monkeypatch.setitem(misleading.SETTINGS, "hill", tiny)
    words = [
        "--seeds",
        "2",
        "--first",
        "3000",
        "--env",
        "hill",
        "--out",
        str(tmp_path / "runs"),
    ]
    assert misleading.main(["run", *words]) == 0
    first = {p: p.stat().st_mtime_ns for p in (tmp_path / "runs").rglob("*.csv")}
    assert len(first) == len(METHODS)
    gone = next(iter(first))
    text = gone.read_bytes()
    gone.unlink()
    assert misleading.main(["run", *words]) == 0
    assert gone.read_bytes() == text
    again = {p: p.stat().st_mtime_ns for p in (tmp_path / "runs").rglob("*.csv")}
    assert {p for p in first if again[p] != first[p]} == {gone}
    monkeypatch.setitem(misleading.SETTINGS, "hill", replace(tiny, total=12))
    other = misleading.SETTINGS["hill"]
    changed = misleading_runs.jobs_of("hill", other, range(3000, 3002))
    assert not misleading_runs.load(changed, tmp_path / "runs")
    monkeypatch.setitem(misleading.SETTINGS, "hill", tiny)
    assert misleading.main(["table", *words, "--to", str(tmp_path / "docs")]) == 0
    finals = pd.read_csv(tmp_path / "docs" / "misleading.csv")
    assert {*METHODS} < {*finals} and {*finals.scenario} == {ONLY, "goal moved"}


def _frame(*returns, stage=(1, 1, 1, 1)):
    rows = [
        {"seed": s, "stage": stage[i], "iteration": 2 * i + 2, "return": x}
        for i in range(4)
        for s, own in enumerate(returns)
        for x in [own[i]]
    ]
    return pd.DataFrame(rows)


def test_measures_of_made_up_curves():
    scale = scale_of(_frame([0.0, 2, 8, 10], [0.0, 4, 8, 10]), 1 / 4)
    assert scale == Scale(0.0, 10.0)
    own = measure(
        _frame([99.0, 99, 4, 8], [99.0, 99, 4, 7], stage=(1, 1, 2, 2)),
        scale,
        1 / 4,
        False,
    )
    np.testing.assert_allclose(own.jumpstart, [4, 4])
    np.testing.assert_allclose(own.time, [1.0, np.inf])
    np.testing.assert_allclose(own.area, [3.0, 2.75])
    np.testing.assert_allclose(own.final, [8, 7])
    assert scale_of(_frame([1.0, 1, 1, 1], [2.0, 2, 2, 2]), 1 / 4) is None


def test_verdicts_of_made_up_numbers():
    assert verdict((-0.3, -0.021)) == "worse"
    assert verdict((-0.02, 0.5)) == "not worse"
    assert verdict((-0.3, -0.02)) == verdict((-0.021, 0.5)) == "undecided"
    rng, plain = np.random.default_rng(0), np.zeros(20)
    gain = 1.0 + 0.1 * rng.standard_normal(20)
    assert kept_gain(gain, 0.96 * gain, plain).verdict == "keeps (point)"
    assert kept_gain(gain, 0.9 * gain, plain).verdict == "loses"
    noisy = 0.93 * gain + 0.3 * (gain.mean() - rng.permutation(gain)) * 5
    assert kept_gain(gain, noisy, plain).verdict == "keeps (interval)"
    assert kept_gain(plain - gain, gain, plain).verdict == "no gain"


def test_the_line_searchs_verdicts():
    assert no_worse((0.5, 9.0)) == "better"
    assert no_worse((-4.9, 1.0)) == "no worse (equivalence)"
    assert no_worse((-5.1, 0.0)) == "no difference shown"
    assert no_worse((-9.0, -0.1)) == "worse"
