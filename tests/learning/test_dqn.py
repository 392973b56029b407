"""DQN's schedule, replay, targets and determinism, and that it learns."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_limits
from torch.nn import functional

from bcrl.common.seeding import stream
from bcrl.envs.linear_system import LinearSystem
from bcrl.evaluation.step_metrics import evaluate
from bcrl.learning.dqn import DQN
from bcrl.learning.lockstep import BLOCK, DQNTrainer
from bcrl.learning.lspi import LSPI
from bcrl.learning.policies import annealed
from bcrl.learning.replay import Replay
from bcrl.learning.stage import snapshots
from bcrl.learning.transfer import (
    Boost,
    PolicyReuse,
    ResidualPolicy,
    Shape,
    StageInit,
    StageResult,
    begin,
    warm_start,
)
from bcrl.q.functions import Table
from bcrl.q.networks.mlp import Networks
from tests.toys import Corridor, last, staged, team

TARGET, LQ = LinearSystem(), LinearSystem("lq", horizon=100)
BRIEF = LinearSystem(horizon=30)  # quick to evaluate
TINY = DQN(
    steps=60,
    random_steps=10,
    learning_starts=5,
    target_update=7,
    hidden=(16,),
    evaluate_every=1,
    evaluation_episodes=2,
)


@pytest.fixture(autouse=True)
def one_thread():
    """Threads only get into each other's way in products this small."""
    with threadpool_limits(1):
        yield


def learn(settings, start=None, env=TARGET, seeds=(0,), number=1):
    stage = staged(settings, env, number)
    return snapshots(settings.learn(stage, start or StageInit(), team(*seeds)))


def weights(moment):
    return moment.learned.residual.online.flat.clone()


# --- the replay ---


def marked(replay, i):
    """Add transition i: seed s's rows say i + 1000 s."""
    mark = i + 1000.0 * np.arange(len(replay.rows))
    wide = np.repeat(mark[:, None], 2, 1)
    replay.add(wide, wide + 0.25, wide + 0.5, mark, mark / 2, np.full(len(mark), i % 2))


def test_the_replay_overwrites_the_oldest():
    replay = Replay.empty(3, 10, 2, 2, "cpu")
    for i in range(27):
        marked(replay, i)
        assert replay.size == min(i + 1, 10)
        held = np.sort(replay.rows[1, : replay.size, 0].numpy()) - 1000.0
        assert held.tolist() == list(range(max(0, i - 9), i + 1))


def test_a_sample_is_the_rows_asked_for():
    replay = Replay.empty(3, 10, 2, 2, "cpu")
    for i in range(14):
        marked(replay, i)
    at = np.random.default_rng(0).integers(10, size=(3, 6))
    batch = replay.sample(torch.from_numpy(at))
    # Place p holds transition p + 10 if that has come, else p.
    i = np.where(at < 4, at + 10, at)
    mark = i + 1000.0 * np.arange(3)[:, None]
    for found, expected in (
        (batch.state, mark[..., None] + [0.0, 0.0]),
        (batch.next_state, mark[..., None] + [0.25, 0.25]),
        (batch.next_base, mark[..., None] + [0.5, 0.5]),
        (batch.fixed, mark),
        (batch.discount, mark / 2),
        (batch.action[..., 0], i % 2),
    ):
        assert np.array_equal(found.numpy(), expected)
    assert batch.action.dtype == torch.int64


@pytest.mark.parametrize("already", [0, 4, 9, 30])
def test_places_are_uniform_over_what_will_be_held(already):
    replay = Replay.empty(2, 10, 2, 2, "cpu")
    for i in range(already):
        marked(replay, i)
    u = np.random.default_rng(1).random((15, 2, 400))
    u[:, :, 0], u[:, :, 1] = 0.0, 1.0 - 2.0**-53
    places = replay.places(u)
    for t in range(15):
        held = min(already + t + 1, 10)
        assert np.array_equal(places[t], np.floor(u[t] * held))
        assert places[t].min() == 0 and places[t].max() == held - 1


# --- when what happens ---


def test_epsilon_by_the_step():
    plain = DQN(random_steps=500, epsilon_start=1.0, epsilon=0.1, anneal_steps=1000)
    assert [plain.epsilon_at(t) for t in (0, 250, 499, 500)] == [1.0] * 4
    assert plain.epsilon_at(1000) == pytest.approx(0.55)
    assert plain.epsilon_at(1499) == pytest.approx(0.1 + 0.9 / 1000)
    assert plain.epsilon_at(1500) == plain.epsilon_at(99_999) == 0.1
    curriculum = DQN(random_steps=0)
    assert curriculum.epsilon_at(0) == curriculum.epsilon_at(20_000) == 0.1
    assert annealed(5, 1.0, 0.0, 20) == 0.75
    assert plain.length == 10_500


def test_epsilon_is_how_often_it_explores():
    """Actions in the replay: uniform while random, then almost all the greedy one."""
    settings = replace(TINY, random_steps=300, steps=300, learning_starts=10_000)
    run = DQNTrainer(settings, staged(settings, TARGET), StageInit(), team(0))
    best = []
    for _ in range(600):
        best.append(int(run.deep(run.state[:, None], 8)[0, 0].argmax()))
        run.act()
        run.end_step()
    action = run.replay.rows[0, :600, -1].numpy().astype(int)
    same = action == np.array(best)
    assert same[:300].mean() == pytest.approx(1 / 8, abs=0.06)
    assert same[300:].mean() == pytest.approx(0.9 + 0.1 / 8, abs=0.05)
    assert np.bincount(action[:300], minlength=8).min() > 20


@pytest.mark.parametrize("random_steps", [0, 500])
def test_the_first_gradient_step_is_that_of_the_501st_transition(random_steps):
    steps = 505 - random_steps
    settings = replace(
        TINY, learning_starts=500, random_steps=random_steps, steps=steps
    )
    moments = learn(settings)
    began, changed = None, {}
    for moment in moments:
        began = weights(moment) if began is None else began
        changed[moment.count] = not torch.equal(weights(moment), began)
        assert np.isnan(moment.loss[0]) == (moment.count <= 500)
    assert [count for count, yes in changed.items() if yes] == [501, 502, 503, 504, 505]


def test_the_target_is_copied_every_few_steps_random_ones_counted():
    online, first = {}, None
    for moment in learn(TINY):
        deep = moment.learned.residual
        online[moment.count] = weights(moment)
        first = weights(moment) if first is None else first
        copied = 7 * (moment.count // 7)
        if copied in online:
            expected = online[copied]
            assert torch.equal(deep.target.flat, expected), moment.count
            assert (copied == moment.count) == torch.equal(
                deep.target.flat, deep.online.flat
            )
        assert deep.steps == moment.count
    assert list(online) == list(range(10, 71))


def test_moments_come_before_the_first_step_and_then_regularly():
    settings = replace(TINY, steps=50, evaluate_every=20)
    stage = staged(settings, TARGET, before=2000)
    found = list(snapshots(settings.learn(stage, StageInit(), team(0))))
    assert [m.count for m in found] == [2010, 2030, 2050, 2060]
    assert [m.last_of_stage for m in found] == [False, False, False, True]


# --- what is greedy ---


def known(best, n=6):
    """A table that prefers `best` by 100 in each of the corridor's cells."""
    values = np.zeros((n, 2))
    values[:, best] = 100.0
    return Table([values], Corridor())


@pytest.mark.parametrize("best", [0, 1])
@pytest.mark.parametrize("greedy_on", ["sum", "residual"])
def test_acting_and_evaluating_are_greedy_on_the_sum_or_on_the_residual(
    best, greedy_on
):
    env, boost = Corridor(), Boost(greedy_on)
    settings = replace(TINY, random_steps=0, epsilon=0.0, learning_starts=1000)
    start = StageInit(base=known(best), boost=boost)
    run = DQNTrainer(settings, staged(settings, env), start, team(0))
    every = env.states()[None]
    own = run.deep(every, 2)[0].argmax(1)
    expected = np.full(6, best) if greedy_on == "sum" else own
    for step in range(40):
        cell = int(run.state[0, 0])
        run.act()
        run.end_step()
        assert run.replay.rows[0, step, -1] == expected[cell]
    lanes = np.tile(every, (1, 1, 1))[:, :4]
    found = run.moment().policy(lanes, np.full((1, 4, 3), 0.5), np.ones((1, 4), bool))
    assert found[0, 2:].tolist() == expected[2:4].tolist()  # the greedy half


# --- seeds ---


def test_different_seeds_start_from_different_weights_and_states():
    fresh = replace(TINY, random_steps=0)
    moment = next(learn(fresh, seeds=(0, 1, 2)))
    flat = moment.learned.residual.online.flat
    assert len(torch.unique(flat[:, 0])) == 3
    assert torch.equal(flat, moment.learned.residual.target.flat)
    later = next(learn(fresh, seeds=(0, 1, 2), number=2))
    assert not torch.equal(flat, weights(later))  # nor the same in the next stage
    run = DQNTrainer(TINY, staged(TINY, TARGET), StageInit(), team(0, 1, 2))
    assert len(np.unique(run.state[:, 2])) == 3


RELEASED = Boost("residual", "two", False), Shape("before_reset", False)
TRANSFERS = {
    "none": (),
    "boost": (Boost(),),
    "released boost": RELEASED[:1],
    "shape": (Shape(),),
    "released shape": RELEASED[1:],
    "both": (Boost(), Shape()),
    "both released": RELEASED,
    "reuse": (PolicyReuse(0.99),),
    "residual policy": (ResidualPolicy(200),),
    "warm start": (warm_start,),
}
SHORT = DQN(
    random_steps=100,
    steps=600,
    learning_starts=300,
    target_update=25,
    hidden=(32, 32),
    evaluate_every=300,
    evaluation_episodes=3,
)


@pytest.fixture(scope="module")
def priors():
    """What LSPI and a short DQN (for the warm start) learned, for 0–4 and 3 alone."""

    def learned(learner, seeds):
        return last(
            learner.learn(staged(learner, LQ), StageInit(), team(*seeds))
        ).learned

    return {
        seeds: {"lspi": learned(LSPI(), seeds), "dqn": learned(SHORT, seeds)}
        for seeds in (tuple(range(5)), (3,))
    }


def trained(name, seeds, priors, settings=SHORT, look=True):
    """The last moment, and all evaluations if they are looked at."""
    previous = priors[seeds]["dqn" if name == "warm start" else "lspi"]
    start, rows = begin(TRANSFERS[name], previous), []
    for moment in learn(settings, start, BRIEF, seeds, number=2):
        if look:
            rows.append(evaluate(moment, seeds))
    return moment, rows


@pytest.mark.parametrize("name", TRANSFERS)
def test_a_seed_alone_is_the_same_among_others(name, priors):
    alone, own = trained(name, (3,), priors)
    among, every = trained(name, tuple(range(5)), priors)
    one, other = alone.learned.residual, among.learned.residual
    assert torch.equal(one.online.flat[0], other.online.flat[3])
    assert torch.equal(one.target.flat[0], other.target.flat[3])
    assert torch.equal(one.optimiser.moments[:, 0], other.optimiser.moments[:, 3])
    assert repr([r[0] for r in own]) == repr([r[3] for r in every])
    assert len({float(x) for x in other.online.flat[:, 5]}) == 5


@pytest.mark.parametrize("name", ["none", "both", "reuse", "residual policy"])
def test_evaluating_changes_no_training(name, priors):
    some, rows = trained(name, (3,), priors)
    never, _ = trained(name, (3,), priors, look=False)
    twice = replace(SHORT, evaluate_every=150)
    often, more = trained(name, (3,), priors, twice)
    for other in (never, often):
        assert torch.equal(weights(some), weights(other))
    assert (len(rows), len(more)) == (3, 5)
    for a, b in zip(rows, more[::2], strict=True):
        for column in a[0].keys() - {"loss"}:  # a mean since the last moment
            assert a[0][column] == b[0][column]


def test_threads_change_no_bit():
    settings = replace(TINY, hidden=(64, 64))
    found = []
    for threads in (1, 2):
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        found.append(weights(last(learn(settings, seeds=(0, 1)))))
        torch.set_num_threads(before)
    assert torch.equal(*found)


# --- learning ---


def test_an_absurd_learning_rate_fails_its_seeds_by_name():
    with np.errstate(all="ignore"):
        moments, absurd = [], replace(TINY, learning_rate=1e30, random_steps=0)
        for moment in learn(replace(absurd, steps=15), env=BRIEF, seeds=(0, 1)):
            evaluate(moment, (0, 1))
            moments.append(moment.failed)
    assert moments[0] == {}
    assert moments[-1] == {0: "non-finite weights", 1: "non-finite weights"}


def test_a_loss_that_is_no_number_fails_its_seed_though_its_weights_are():
    run = DQNTrainer(TINY, staged(TINY, TARGET), StageInit(), team(0, 1, 2))
    run.loss[1], run.loss[2] = np.nan, np.inf
    run.updates = 1
    assert run.moment().failed == {1: "non-finite loss", 2: "non-finite loss"}


def test_one_seeds_weights_that_fail_leave_the_others_alone():
    settings = replace(TINY, steps=30)
    expected = weights(last(learn(settings, seeds=(0, 1, 2))))
    for moment in learn(settings, seeds=(0, 1, 2)):
        if moment.count == 20:
            moment.learned.residual.online.flat[1] = np.nan
        assert list(moment.failed) == ([] if moment.count <= 20 else [1])
    found = weights(moment)
    assert torch.equal(found[[0, 2]], expected[[0, 2]])


@pytest.mark.parametrize("transfers", [(), (Boost(),), (Shape(),), (Boost(), Shape())])
def test_it_learns_to_walk_the_corridor(transfers):
    env = Corridor()
    settings = DQN(
        steps=700,
        random_steps=100,
        learning_starts=100,
        epsilon_start=1.0,
        anneal_steps=300,
        target_update=20,
        hidden=(32, 32),
        learning_rate=3e-3,
        evaluate_every=700,
        evaluation_episodes=10,
    )
    start = StageInit()
    if transfers:  # the first task's Q goes the wrong way
        values = np.linspace(0.0, 1.0, 6)[:, None] + [3.0, 0.0]
        prior = Table([values, values], env)
        start = begin(transfers, StageResult(prior, prior))
    first, *_, final = (
        (moment, evaluate(moment, (0, 1)))
        for moment in learn(settings, start, env, (0, 1))
    )
    assert all(row["greedy_success_rate"] == 1.0 for row in final[1])
    assert all(row["success_rate"] == 1.0 for row in final[1])  # ε = 0.1, 30 steps
    if Boost() in transfers:
        assert all(row["greedy_success_rate"] == 0.0 for row in first[1])
    # Cell i is 5 − i steps away: the prize 0.9^(4−i), less 0.1 a step before.
    q = final[0].learned.q(np.tile(env.states(), (2, 1, 1)), 2)[:, :5]
    steps = 0.9 ** np.arange(4, -1, -1.0)
    assert (q.argmax(-1) == 1).all()
    assert np.allclose(q.max(-1), steps - (1.0 - steps), atol=0.1)


def module_values(deep, flat, x):
    """ReLU network by plain matrix products."""
    layers = Networks(deep.online.sizes, flat[None]).layers
    for i, (w, b) in enumerate(layers):
        x = x @ w[0] + b[0, 0]
        x = x.relu() if i < len(layers) - 1 else x
    return x


@pytest.mark.parametrize("every", [1, 10])
def test_the_recorded_loss_is_torchs_mean_since_the_last_moment(every):
    """Batches too: uniforms of the seed's own stream pick among what is held."""
    settings = replace(TINY, evaluate_every=every, replay_size=30)
    seeds, d, n = (4, 9), 4, 8
    run = DQNTrainer(settings, staged(settings, TARGET), StageInit(), team(*seeds))
    picks = [stream(s, "replay", 1, 0).random((BLOCK, 32)) for s in seeds]
    losses, sides = [[], []], set()
    for step in range(settings.length):
        run.act()
        if run.replay.size > settings.learning_starts:
            held = min(step + 1, 30)
            for s in range(2):
                rows = run.replay.rows[s, (picks[s][step] * held).astype(int)]
                online, target = run.deep.online.flat[s], run.deep.target.flat[s]
                after = module_values(run.deep, target, rows[:, d : 2 * d])
                best = (after + rows[:, 2 * d : 2 * d + n]).max(1).values
                y = rows[:, -3] + rows[:, -2] * best
                values = module_values(run.deep, online, rows[:, :d])
                chosen = values[torch.arange(32), rows[:, -1].long()]
                losses[s].append(functional.smooth_l1_loss(chosen, y).item())
                sides |= {bool(x) for x in (chosen - y).abs() > 1.0}
            run.update()
        run.end_step()
        if (step + 1) % every == 0 and losses[0]:
            found = run.moment().loss
            for s in range(2):
                assert found[s] == pytest.approx(np.mean(losses[s]), rel=1e-4)
            losses = [[], []]
    assert sides == {True, False}
    assert np.isnan(run.moment().loss).all()


def test_transitions_are_the_environments_and_discounts_its_gamma():
    settings = replace(TINY, random_steps=200, steps=1, learning_starts=1000)
    env = Corridor(horizon=7)
    run = DQNTrainer(settings, staged(settings, env), StageInit(), team(0, 1))
    for _ in range(200):
        run.act()
        run.end_step()
    for s in range(2):
        rows = run.replay.rows[s, :200].double().numpy()
        action = rows[:, -1].astype(int)
        after, reward, absorbing = env.step(rows[:, :1], action)
        assert np.array_equal(rows[:, 1:2], after)
        assert np.allclose(rows[:, -3], reward)
        assert np.allclose(rows[:, -2], np.where(absorbing, 0.0, 0.9))
        steps = 0
        for i in range(199):
            steps += 1
            if absorbing[i] or steps == 7:
                steps = 0
            else:
                assert rows[i + 1, 0] == rows[i, 1]
        assert absorbing.any()
