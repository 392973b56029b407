"""DQN's schedule, replay, targets and determinism, and that it learns."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_limits

from bcrl.api import Boost, PolicyReuse, ResidualPolicy, Shape, warm_start
from bcrl.envs.linear_system import LinearSystem
from bcrl.evaluation.step_metrics import evaluate
from bcrl.learning.dqn import DQN
from bcrl.learning.dqn_trainer import DQNTrainer
from bcrl.learning.lspi import LSPI
from bcrl.learning.replay import Replay
from bcrl.learning.transfer import StageInit, StageResult, begin
from bcrl.q.functions import Table
from tests.toys import Corridor, last, snapshots, staged, team

TARGET, LQ = LinearSystem(), LinearSystem("lq", horizon=100)
BRIEF = LinearSystem(horizon=30)  # quick to evaluate
OFTEN = {"evaluate_every": 1, "evaluation_episodes": 2}
TINY = DQN(60, 10, learning_starts=5, target_update=7, hidden=(16,), **OFTEN)


@pytest.fixture(autouse=True)
def one_thread():
    """More threads slow down products this small."""
    with threadpool_limits(1):
        yield


def learn(settings, start=None, env=TARGET, seeds=(0,), number=1):
    stage = staged(settings, env, number)
    return snapshots(settings.learn(stage, start or StageInit(), team(*seeds)))


def trainer(settings, start=None, env=TARGET, seeds=(0,)):
    stage = staged(settings, env)
    return DQNTrainer(settings, stage, start or StageInit(), team(*seeds), None)


def weights(snapshot):
    return snapshot.result.residual.online.flat.clone()


@pytest.mark.parametrize("added", [4, 9, 27])
def test_the_replay_overwrites_the_oldest_and_draws_among_all(added):
    replay, seeds = Replay.empty(3, 10, 2, 2, "cpu"), 1000.0 * np.arange(3)
    for i in range(added):
        mark = i + seeds
        wide = np.repeat(mark[:, None], 2, 1)
        action = np.full(3, i % 2)
        replay.add(wide, wide + 0.25, wide + 0.5, mark, mark / 2, action)
    assert replay.size == min(added, 10)
    at = np.arange(replay.size)
    i = at + 10 * ((added - 1 - at) // 10)  # the latest transition in that row
    mark = (i + seeds[:, None])[..., None]
    columns = [mark] * 2 + [mark + 0.25] * 2 + [mark + 0.5] * 2 + [mark, mark / 2]
    expected = np.concatenate([*columns, mark * 0 + i[:, None] % 2], -1)
    assert np.array_equal(replay.rows[:, : replay.size].numpy(), expected)
    u = np.random.default_rng(1).random((15, 2, 400))
    u[:, :, 0], u[:, :, 1] = 0.0, 1.0 - 2.0**-53
    for t, indices in enumerate(replay.indices(u)):  # after t + 1 more were added
        assert np.array_equal(indices, np.floor(u[t] * min(added + t + 1, 10)))


def test_epsilon_by_the_step():
    plain = DQN(random_steps=500, epsilon_start=1.0, epsilon=0.1, anneal_steps=1000)
    assert [plain.epsilon_at(t) for t in (0, 499, 500)] == [1.0] * 3
    assert plain.epsilon_at(1499) == pytest.approx(0.1 + 0.9 / 1000)
    assert plain.epsilon_at(1500) == plain.epsilon_at(99_999) == 0.1
    assert DQN(random_steps=0).epsilon_at(0) == 0.1
    assert plain.length == 10_500


@pytest.mark.parametrize("random_steps", [0, 500])
def test_the_first_gradient_step_is_that_of_the_501st_transition(random_steps):
    settings = replace(TINY, learning_starts=500, random_steps=random_steps)
    found = list(learn(replace(settings, steps=503 - random_steps)))
    changed = [s.count for s in found if not np.isnan(s.loss[0])]
    assert changed == [501, 502, 503]


def test_the_target_is_copied_every_few_steps_random_ones_counted():
    online = {}
    for snapshot in learn(TINY):
        deep, count = snapshot.result.residual, snapshot.count
        online[count] = weights(snapshot)
        copied = 7 * (count // 7)
        if copied in online:
            assert torch.equal(deep.target.flat, online[copied]), count
            equal = torch.equal(deep.target.flat, deep.online.flat)
            assert equal == (copied == count)
        assert deep.steps == count
    assert list(online) == list(range(10, 71))


def test_snapshots_come_before_the_first_step_and_then_regularly():
    settings = replace(TINY, steps=50, evaluate_every=20)
    stage = staged(settings, TARGET, before=2000)
    found = list(snapshots(settings.learn(stage, StageInit(), team(0))))
    assert [s.count for s in found] == [2010, 2030, 2050, 2060]
    assert [s.last_of_stage for s in found] == [False, False, False, True]


@pytest.mark.parametrize("best", [0, 1])
@pytest.mark.parametrize("greedy_on", ["sum", "residual"])
def test_acting_and_evaluating_are_greedy_on_the_sum_or_on_the_residual(
    best, greedy_on
):
    env, values = Corridor(), np.zeros((6, 2))
    values[:, best] = 100.0
    start = StageInit(base=Table([values], env), boost=Boost(greedy_on))
    settings = replace(TINY, random_steps=0, epsilon=0.0, learning_starts=1000)
    run, every = trainer(settings, start, env), env.states()[None]
    own = run.state.deep(every, 2)[0].argmax(1)
    expected = np.full(6, best) if greedy_on == "sum" else own
    for step in range(40):
        cell = int(run.state.env_state[0, 0])
        run.act()
        run.end_step()
        assert run.state.replay.rows[0, step, -1] == expected[cell]
    policy, alive = run.snapshot().policy, np.ones((1, 4), bool)
    found = policy(every[:, :4], np.full((1, 4, 3), 0.5), alive)
    assert found[0, 2:].tolist() == expected[2:4].tolist()  # the greedy half


TRANSFERS = {
    "none": (),
    "both": (Boost(), Shape()),
    "both released": (Boost("residual", "two", False), Shape("before_reset", False)),
    "reuse": (PolicyReuse(0.99),),
    "residual policy": (ResidualPolicy(200),),
    "warm start": (warm_start,),
}
LOOK = {"evaluate_every": 300, "evaluation_episodes": 3}
SHORT = DQN(600, 100, learning_starts=300, target_update=25, hidden=(32, 32), **LOOK)


@pytest.fixture(scope="module")
def priors():
    """What LSPI and a short DQN (for the warm start) learned, for 0–4 and 3 alone."""

    def learned(learner, seeds):
        stage = staged(learner, LQ)
        return last(learner.learn(stage, StageInit(), team(*seeds))).result

    return {
        seeds: {"lspi": learned(LSPI(), seeds), "dqn": learned(SHORT, seeds)}
        for seeds in (tuple(range(5)), (3,))
    }


def trained(name, seeds, priors, settings=SHORT, look=True):
    """The last snapshot, and all evaluations if `look`."""
    previous = priors[seeds]["dqn" if name == "warm start" else "lspi"]
    start, rows = begin(TRANSFERS[name], previous), []
    for snapshot in learn(settings, start, BRIEF, seeds, number=2):
        if look:
            rows.append(evaluate(snapshot, seeds)[0])
    return snapshot, rows


@pytest.mark.parametrize("name", TRANSFERS)
def test_a_seed_alone_is_the_same_among_others(name, priors):
    alone, own = trained(name, (3,), priors)
    among, every = trained(name, tuple(range(5)), priors)
    one, other = alone.result.residual, among.result.residual
    assert torch.equal(one.online.flat[0], other.online.flat[3])
    assert torch.equal(one.target.flat[0], other.target.flat[3])
    assert torch.equal(one.optimiser.moments[:, 0], other.optimiser.moments[:, 3])
    assert repr([r[0] for r in own]) == repr([r[3] for r in every])
    assert len({float(x) for x in other.online.flat[:, 5]}) == 5


@pytest.mark.parametrize("name", ["both", "residual policy"])
def test_evaluating_changes_no_training(name, priors):
    some, rows = trained(name, (3,), priors)
    never, _ = trained(name, (3,), priors, look=False)
    often, more = trained(name, (3,), priors, replace(SHORT, evaluate_every=150))
    for other in (never, often):
        assert torch.equal(weights(some), weights(other))
    assert (len(rows), len(more)) == (3, 5)
    for a, b in zip(rows, more[::2], strict=True):
        for column in a[0].keys() - {"loss"}:  # a mean since the last snapshot
            assert a[0][column] == b[0][column]


def test_one_seeds_weights_or_loss_that_fail_leave_the_others_alone():
    settings = replace(TINY, steps=30)
    expected = weights(last(learn(settings, seeds=(0, 1, 2))))
    for snapshot in learn(settings, seeds=(0, 1, 2)):
        if snapshot.count == 20:
            snapshot.result.residual.online.flat[1] = np.nan
        later = {1: "non-finite weights"} if snapshot.count > 20 else {}
        assert snapshot.failed == later
    assert torch.equal(weights(snapshot)[[0, 2]], expected[[0, 2]])
    run = trainer(TINY, seeds=(0, 1, 2))
    run.state.loss[1:], run.state.updates = (np.nan, np.inf), 1
    assert run.snapshot().failed == {1: "non-finite loss", 2: "non-finite loss"}


@pytest.mark.parametrize("transfers", [(), (Boost(), Shape())])
def test_it_learns_to_walk_the_corridor(transfers):
    env, start = Corridor(), StageInit()
    explore = {"learning_starts": 100, "epsilon_start": 1.0, "anneal_steps": 300}
    fit = {"target_update": 20, "hidden": (32, 32), "learning_rate": 3e-3}
    look = {"evaluate_every": 700, "evaluation_episodes": 10}
    settings = DQN(700, 100, **explore, **fit, **look)
    if transfers:  # the first task's Q goes the wrong way
        values = np.linspace(0.0, 1.0, 6)[:, None] + [3.0, 0.0]
        prior = Table([values, values], env)
        start = begin(transfers, StageResult(prior, prior))
    first, *_, final = (
        (snapshot, evaluate(snapshot, (0, 1))[0])
        for snapshot in learn(settings, start, env, (0, 1))
    )
    assert all(row["greedy_success_rate"] == 1.0 for row in final[1])
    assert all(row["success_rate"] == 1.0 for row in final[1])  # ε = 0.1, 30 steps
    if transfers:
        assert all(row["greedy_success_rate"] == 0.0 for row in first[1])
    # Cell i is 5 − i steps away: the prize 0.9^(4−i), less 0.1 per step before.
    q = final[0].result.q(np.tile(env.states(), (2, 1, 1)), 2)[:, :5]
    steps = 0.9 ** np.arange(4, -1, -1.0)
    assert (q.argmax(-1) == 1).all()
    assert np.allclose(q.max(-1), steps - (1.0 - steps), atol=0.1)


def test_the_recorded_loss_is_the_mean_since_the_last_snapshot():
    every, tenth = (
        {x.count: x.loss for x in learn(replace(TINY, evaluate_every=n), seeds=(4, 9))}
        for n in (1, 10)
    )
    assert list(tenth) == [*range(10, 71, 10)]
    for count in list(tenth)[1:]:
        since = [every[i] for i in range(count - 9, count + 1)]
        assert tenth[count] == pytest.approx(np.mean(since, 0))
