"""The scale of the base: its closed form, and what FQI and DQN do with it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from bcrl.api import Boost, Shape, stages
from bcrl.envs.linear_system import LinearSystem
from bcrl.envs.maze import Maze
from bcrl.errors import ConfigError
from bcrl.learning import dqn_trainer
from bcrl.learning.dqn import DQN
from bcrl.learning.fqi import FQI
from bcrl.learning.line_search import LEAST, best_scale, fit_of, robust_weights, search
from bcrl.learning.rollout import rollout
from bcrl.learning.stage import SeedBatch, Stage, learn
from bcrl.learning.transfer import StageInit, StageResult, begin
from bcrl.q.functions import Scaled, Sum, Table, add, scaled
from bcrl.q.regressors.ours import ForestRegressor, Tabular
from tests.learning.test_transfer import Known, run_of
from tests.toys import Corridor, last, snapshots, staged

SEARCH = Boost(alpha="search")
GAMMA = 0.9
TARGET = LinearSystem()
SETTINGS = DQN(200, 0, learning_starts=LEAST, target_update=40, hidden=(16,))


def sample(n=400, seed=0):
    """Random rewards and values, a third of the next states absorbing."""
    rng = np.random.default_rng(seed)
    reward, base = rng.normal(size=n), rng.normal(size=n)
    return reward, base, rng.normal(size=(n, 3)), rng.random(n) < 0.3


def residual(alpha, reward, base, next_base, absorbing):
    """The Bellman residual of alpha · base, by its definition."""
    best = (alpha * next_base).max(-1)
    return reward + GAMMA * np.where(absorbing, 0.0, best) - alpha * base


@pytest.mark.parametrize("seed", range(8))
def test_the_closed_form_is_the_best_scale(seed):
    data = sample(seed=seed)
    reward, base, next_base, absorbing = data
    gain = -residual(1.0, 0.0 * reward, *data[1:])
    counts = np.random.default_rng(seed).integers(1, 5, len(reward))

    def loss(alpha):
        return (counts * residual(alpha, *data) ** 2).sum()

    found = minimize_scalar(loss, bounds=(0.0, 10.0), method="bounded").x
    alpha = best_scale(reward, gain, counts)
    assert alpha == pytest.approx(found, abs=1e-5)
    share = 1.0 - loss(alpha) / loss(0.0)
    assert fit_of(alpha, reward, gain, counts) == pytest.approx(share)
    repeated = [np.repeat(x, counts, 0) for x in (reward, base, next_base, absorbing)]
    assert search(*repeated, GAMMA)[0] == pytest.approx(
        search(*data, GAMMA, counts)[0], rel=1e-12
    )


@pytest.mark.parametrize("seed", range(4))
def test_the_robust_scale_is_the_best_for_dqns_loss(seed):
    reward, base, next_base, absorbing = sample(seed=seed)
    gain = base - GAMMA * np.where(absorbing, 0.0, next_base.max(-1))
    reward, gain = -5.0 + reward, gain - 10.0
    gain[:3] += 300.0  # falls back to the start

    def loss(alpha):
        error = np.abs(reward - alpha * gain)
        return np.where(error < 1.0, 0.5 * error**2, error - 0.5).sum()

    options = {"bounds": (0.0, 2.0), "method": "bounded", "options": {"xatol": 1e-9}}
    alpha = best_scale(reward, gain, robust_weights(reward, gain))
    assert loss(alpha) == pytest.approx(minimize_scalar(loss, **options).fun, rel=1e-6)
    assert alpha > 0.4 and best_scale(reward, gain) < 0.2


@pytest.mark.parametrize("scale", [0.01, 0.3, 5.0, 100.0])
def test_a_base_on_another_scale_is_brought_back(scale):
    _, base, next_base, absorbing = sample()
    reward = base - GAMMA * np.where(absorbing, 0.0, next_base.max(-1))
    alpha, fit, note = search(reward, base / scale, next_base / scale, absorbing, GAMMA)
    assert (alpha, fit, note) == (pytest.approx(scale), pytest.approx(1.0), "")


@pytest.mark.parametrize("scale", [0.6, 0.8, 1.0, 1.5, 3.0])
def test_a_base_that_is_nearly_right_stays_as_it_is(scale):
    _, base, next_base, absorbing = sample()
    reward = base - GAMMA * np.where(absorbing, 0.0, next_base.max(-1))
    known = reward, base / scale, next_base / scale, absorbing
    alpha, fit, _ = search(*known, GAMMA)
    assert alpha == 1.0 and fit >= 0.5
    assert fit == pytest.approx(fit_of(1.0, reward, reward / scale))


@pytest.mark.parametrize("gamma", [0.5, 0.95, 0.99])
@pytest.mark.parametrize("robust", [False, True])
def test_an_exact_base_is_kept_where_all_rewards_are_equal(gamma, robust):
    """Its values vary little, so that shuffled they would explain much, too."""
    steps = np.tile(np.arange(int(4 / (1 - gamma)), int(8 / (1 - gamma))), 20)
    base, after = (-(1 - gamma**n) / (1 - gamma) for n in (steps, steps - 1))
    known = base, np.stack([after, after - 1.0], 1), steps == 1
    reward = np.full(len(steps), -1.0)
    assert search(reward, *known, gamma, robust=robust)[0] == 1.0
    noise = np.random.default_rng(0).permutation(base), known[1], known[2]
    assert search(reward, *noise, gamma, robust=robust)[0] == 0.0


@pytest.mark.parametrize("unit", [1e-170, 1e-3, 1e160])
def test_any_unit_of_rewards_and_bases_gives_the_same(unit):
    reward, base, next_base, absorbing = sample()
    reward = 0.3 * (base - GAMMA * np.where(absorbing, 0.0, next_base.max(-1)))
    known = unit * base, unit * next_base, absorbing, GAMMA
    with np.errstate(all="raise"):
        assert search(reward, *known)[0] == pytest.approx(0.3 / unit)
        alpha, fit, _ = search(unit * reward, base, next_base, absorbing, GAMMA)
    assert (alpha, fit) == (pytest.approx(0.3 * unit), pytest.approx(1.0))


def test_noise_and_a_base_of_the_opposite_sign_are_left_out():
    reward, base, next_base, absorbing = sample(100_000)
    next_base = next_base - 4.0  # so that its gain is positive as the reward is
    alpha, fit, note = search(reward + 5.0, base, next_base, absorbing, GAMMA)
    assert (alpha, fit) == (0.0, 0.0) and "chance" in note
    assert not any(search(*sample(LEAST, seed), GAMMA)[0] for seed in range(200))
    gain = base - GAMMA * np.where(absorbing, 0.0, next_base.max(-1))
    assert search(-gain, base, next_base, absorbing, GAMMA)[:2] == (0.0, 0.0)


@pytest.mark.parametrize("what", ["few", "zero", "nan", "inf", "unrewarded", "lost"])
def test_where_nothing_can_be_searched_alpha_is_1_with_a_note(what):
    reward, base, next_base, absorbing = sample(LEAST - (what == "few"))
    factor = {"zero": 0.0, "nan": np.nan, "inf": np.inf}.get(what, 1.0)
    reward = reward * {"unrewarded": 0.0, "lost": np.nan}.get(what, 1.0)
    base, next_base = factor * np.abs(base), factor * np.abs(next_base)
    with np.errstate(all="raise"):
        alpha, fit, note = search(reward, base, next_base, absorbing, GAMMA)
    assert alpha == 1.0 and np.isnan(fit) and note


@pytest.mark.parametrize("alpha", ["best", -0.1, True, float("inf"), float("nan")])
def test_only_factors_are_accepted(alpha):
    with pytest.raises(ConfigError, match="alpha"):
        Boost(alpha=alpha)


# --- FQI ---


def runs(*transfers, tasks, seeds=(0, 1), iterations=6, **options):
    learner = FQI(iterations, 60, **({"regressor": Tabular()} | options))
    batch = SeedBatch(seeds, tasks[0].states())
    pairs = enumerate(tasks)
    made = [
        Stage(i + 1, i + 1, env, learner, transfers, i * iterations) for i, env in pairs
    ]
    return list(learn(made, batch))


def test_fqi_learns_what_it_learned_when_the_scale_is_right():
    tasks = [Corridor(), Corridor(prize=1.1)]
    options = {"tasks": tasks, "regressor": ForestRegressor(trees=5), "iterations": 8}
    for transfers in ((), (Shape(),)):
        searched = runs(SEARCH, *transfers, **options)
        plain = runs(Boost(), *transfers, **options)
        for a, b in zip(searched, plain, strict=True):
            assert np.array_equal(a.probed_q, b.probed_q)
        assert searched[0].searched is None and plain[-1].searched is None
        assert searched[-1].searched.alpha.tolist() == [1.0, 1.0]


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_fqi_undoes_another_scale_of_rewards(scale):
    """A task whose rewards have another scale helps as much as the task itself."""
    base = runs(tasks=[Corridor()], iterations=60)[-1].result
    task = Corridor()
    far = StageResult(Scaled(base.q, np.full(2, scale)), base.residual)
    stage = staged(FQI(1, 60, regressor=Tabular()), task, 2)
    batch = SeedBatch((0, 1), task.states())
    first = next(stage.learner.learn(stage, begin((SEARCH,), far), batch))
    assert np.allclose(first.searched.alpha, 1 / scale)
    assert np.allclose(first.probed_q, base.q([task.states()] * 2, 2), atol=1e-6)
    fixed = begin((Boost(alpha=1 / scale),), far)
    same = next(stage.learner.learn(stage, fixed, batch))
    assert np.allclose(same.probed_q, first.probed_q)
    assert np.isnan(same.searched.base_fit).all()


def test_a_base_of_noise_gives_the_plain_algorithms_results():
    """The greedy policies' lengths in a maze are those without a base, on average."""
    task, seeds = Maze(height=0.25), tuple(range(8))
    rng = np.random.default_rng(1)
    noise = Table([50.0 * rng.normal(size=(441, 4)) for _ in seeds], task)
    batch = SeedBatch(seeds, task.states())
    learner = FQI(50, 200, regressor=ForestRegressor(trees=10), evaluate_every=50)
    stage, ends = staged(learner, task, 2), {}
    for name, transfers in (("plain", ()), ("search", (SEARCH,)), ("one", (Boost(),))):
        start = begin(transfers, StageResult(noise, noise))
        start = replace(start, previous=None)  # its own random data
        ends[name] = last(snapshots(learner.learn(stage, start, batch)))
    assert ends["search"].searched.alpha.max() < 0.02
    begun, u = np.zeros((8, 1, 2)), np.zeros((8, task.horizon, 1, 2))
    plain, found, kept = (
        rollout(task, end.result.q, begun, u).length.mean() for end in ends.values()
    )
    assert abs(found - plain) < 0.1 * plain
    assert kept > 1.5 * plain


@pytest.mark.parametrize("alpha", [0.5, 0.0, "search"])
def test_a_seed_whose_base_is_infinite_fails_alone(alpha):
    task, learner = Corridor(), FQI(2, 20, regressor=Tabular())
    values = [np.zeros((6, 2)) - 1.0, np.full((6, 2), -np.inf)]
    lost = Table(values, task)
    stage, batch = staged(learner, task, 2), SeedBatch((0, 1), task.states())
    start = begin((Boost(alpha=alpha),), StageResult(lost, lost))
    start = replace(start, previous=None)
    with np.errstate(all="raise"):
        end = last(snapshots(learner.learn(stage, start, batch)))
    assert [*end.failed] == [1] and np.isfinite(end.probed_q[0]).all()


def test_only_fqi_and_dqn_apply_the_factor():
    class Own:
        name, length = "own", 1

        def learn(self, stage, start, batch, state=None):
            yield

    with pytest.raises(ConfigError, match=r"boosting.alpha=search.* Own"):
        stages([Corridor(), Corridor(2.0)], Own(), SEARCH)


def test_a_wrapped_boost_is_known_by_what_it_does():
    def own(start, previous):
        return SEARCH(start, previous)

    course = stages([Corridor(), Corridor(2.0)], FQI(1, regressor=Tabular()), own)
    assert [stage.boost.alpha for stage in course] == ["search", "search"]


# --- DQN ---


def trained(boost, shape=None, seeds=(0, 1), base=None, steps=150):
    base = base or Known()
    start = StageInit(base=base, boost=boost)
    if shape is not None:
        start = replace(start, potential=base, shape=shape)
    run = run_of(start, SETTINGS, TARGET, seeds)
    for _ in range(steps):
        run.act()
        if run.state.replay.size > SETTINGS.learning_starts:
            run.update()
        run.end_step()
    return run


@pytest.mark.parametrize("shape", [None, Shape()])
def test_dqn_with_the_scale_1_is_equation_5(monkeypatch, shape):
    monkeypatch.setattr(dqn_trainer, "search", lambda *known, robust: (1.0, 0.5, ""))
    searched, plain = trained(SEARCH, shape), trained(Boost(), shape)
    assert searched.state.searched.alpha.tolist() == [1.0, 1.0]
    assert searched.state.unscaled is None and plain.state.searched is None
    for get in (lambda s: s.replay.rows, lambda s: s.deep.online.flat):
        assert get(searched.state).equal(get(plain.state))


@pytest.mark.parametrize("shape", [None, Shape()])
def test_what_dqn_stored_before_the_search_is_restated(monkeypatch, shape):
    """The replay has the rows that it would have had with the scale from the start."""
    steps, alpha = LEAST + 1, {0: 0.125, 1: 4.0}
    found = iter([*alpha.values()])
    monkeypatch.setattr(
        dqn_trainer, "search", lambda *known, robust: (next(found), 0.5, "")
    )
    run = trained(SEARCH, shape, steps=steps)
    replay = run.state.replay
    state, after = replay.rows[..., :4].double(), replay.rows[..., 4:8].double()
    for seed, factor in alpha.items():
        q = Scaled(Known(), np.full(2, factor))
        base, later = (q(x.numpy(), 8)[seed, :steps] for x in (state, after))
        row = replay.rows[seed, :steps].double().numpy()
        own = base[np.arange(steps), row[:, -1].astype(int)]
        reward = np.where(row[:, -2] == 0.0, 0.0, -1.0)
        if shape is not None:
            reward += row[:, -2] * later.max(-1) - base.max(-1)
        assert np.allclose(row[:, 8:16], later, atol=1e-3)
        assert np.allclose(row[:, -3], reward - own, atol=1e-3)


def test_dqns_scale_is_each_seeds_own():
    """It is that of the first transitions, alone and in a batch."""
    both, alone = trained(SEARCH), trained(SEARCH, seeds=(1,))
    assert both.state.searched.alpha[1] == alone.state.searched.alpha[0]
    assert both.state.replay.rows[1].equal(alone.state.replay.rows[0])
    base = both.snapshot().result.q.terms[0]
    assert isinstance(base, Scaled)
    assert np.array_equal(base.factor, both.state.searched.alpha)
    fixed = trained(Boost(alpha=0.5)).snapshot().result.q.terms[0]
    assert fixed.factor.tolist() == [0.5, 0.5]


def test_a_stage_without_an_update_says_that_it_did_not_search():
    run = trained(SEARCH, steps=20)
    assert run.snapshot().searched is None
    run.state.step = run.settings.length
    found = run.snapshot().searched
    assert found.alpha.tolist() == [1.0, 1.0] and set(found.reasons) == {0, 1}


def test_a_scaled_sum_stays_a_flat_one():
    one = scaled(Sum((Known(), Known(2))), np.array([2.0, 3.0]))
    assert [type(term) for term in add(one, Known()).terms] == [Scaled, Scaled, Known]
    assert scaled(one, np.array([0.5, 1.0])).terms[1].factor.tolist() == [1.0, 3.0]
    states = np.random.default_rng(0).normal(size=(2, 5, 4))
    parts = [Known()(states, 8), Known(2)(states, 8), Known(1)(states, 8)]
    expected = np.array([2.0, 3.0])[:, None, None] * (parts[0] + parts[1]) + parts[2]
    assert np.allclose(add(one, Known(1))(states, 8), expected)
