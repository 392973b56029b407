"""What each transfer does to rewards, actions and networks, by hand."""

import math
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch

from bcrl.api import Boost, PolicyReuse, ResidualPolicy, Shape, warm_start
from bcrl.common.seeding import stream
from bcrl.envs.linear_system import LinearSystem
from bcrl.errors import ConfigError
from bcrl.learning.dqn import DQN
from bcrl.learning.dqn_trainer import CHOICES, DRAW_BLOCK, DQNTrainer
from bcrl.learning.policies import combined_actions
from bcrl.learning.transfer import StageInit, StageResult, begin
from bcrl.q.functions import ZERO, Sum
from tests.toys import last, staged, team

TARGET = LinearSystem()
RELEASED_BOOST = Boost("residual", "two", False)
RELEASED_SHAPE = Shape("before_reset", False)
SMALL = DQN(hidden=(16,), random_steps=0, steps=100, learning_starts=1000)


class Known:
    """V(s) = 7 x + 3 y + 40, and Q(s, a) = V(s) − distance of a to the `best`."""

    def __init__(self, best=0):
        self.best = best

    def __call__(self, states, n_actions):
        x = np.moveaxis(np.asarray(states), -1, 0)
        return value(x)[..., None] - np.abs(np.arange(n_actions) - self.best)


def value(state):
    return 7.0 * state[0] + 3.0 * state[2] + 40.0


def run_of(start, settings=SMALL, env=TARGET, seeds=(0,)):
    return DQNTrainer(settings, staged(settings, env, 2), start, team(*seeds), None)


def stored(run, at=0):
    """The first seed's row in the replay, by name."""
    row = run.state.replay.rows[0, at].double().numpy()
    d, n = run.env.state_dim, run.env.n_actions
    parts = np.split(row, [d, 2 * d, 2 * d + n, 2 * d + n + 1, 2 * d + n + 2])
    names = ("state", "after", "next_base", "fixed", "discount", "action")
    return {k: v if len(v) > 1 else v[0] for k, v in zip(names, parts, strict=True)}


def step_from(start, state):
    """The transition that a single seed stores from `state`."""
    fresh = run_of(start)
    fresh.state.env_state = np.array([state], float)
    run = DQNTrainer(SMALL, fresh.stage, start, fresh.batch, fresh.state)
    run.act()
    return stored(run)


PATH = (-2.0, 0.0, 0.1, 0.0)
FALLING = (-2.0, 0.0, 0.45, 3.0)  # y = 0.6 after a step
ARRIVING = (-0.25, 2.5, 0.0, 0.0)  # x = -0.15 after a step
FALL_ROW = (-2.0 - 0.5 * 0.05, 0.0, 0.45 + 3.0 * 0.05, 0.0)  # where FALLING leads
STATES = pytest.mark.parametrize("at", [PATH, FALLING, ARRIVING])


@pytest.mark.parametrize("shape", [Shape(), RELEASED_SHAPE, Shape("before_reset")])
@STATES
def test_the_shaped_reward_of_a_step(shape, at):
    row = step_from(StageInit(potential=Known(), shape=shape), at)
    absorbing, leads_to = at == ARRIVING, row["after"]
    if at == FALLING:
        assert leads_to[0] == pytest.approx(-4.0, abs=2e-3)  # the fresh start is stored
        if shape.next_state == "before_reset":
            leads_to = FALL_ROW
    after = 0.0 if absorbing and shape.zero_at_goal else value(leads_to)
    expected = (0.0 if absorbing else -1.0) + 0.99 * after - value(at)
    assert row["fixed"] == pytest.approx(expected, abs=1e-4)
    assert row["discount"] == pytest.approx(0.0 if absorbing else 0.99)
    assert not row["next_base"].any()


@STATES
@pytest.mark.parametrize("boost", [Boost(), RELEASED_BOOST, Boost(maxima="two")])
def test_what_a_boosted_step_stores(at, boost):
    row = step_from(StageInit(base=Known(best=3), boost=boost), at)
    base = value(at) - abs(row["action"] - 3)
    next_values = value(row["after"]) - np.abs(np.arange(8) - 3)
    residual = np.linspace(-2.0, 3.0, 8)
    bootstrap = (residual + next_values).max()
    if boost.maxima == "two":
        bootstrap = residual.max() + next_values.max()
    if at == ARRIVING:
        bootstrap = 0.0 if boost.mask_at_goal else next_values.max()
    expected = (0.0 if at == ARRIVING else -1.0) + 0.99 * bootstrap - base
    found = row["fixed"] + row["discount"] * (residual + row["next_base"]).max()
    assert found == pytest.approx(expected, abs=1e-4)


def test_the_horizons_end_is_bootstrapped_from_and_starts_anew():
    run = run_of(StageInit(), env=replace(TARGET, horizon=3))
    for step in range(4):
        before = run.state.env_state.copy()
        run.act()
        run.end_step()
        assert stored(run, step)["discount"] == pytest.approx(0.99)
        assert np.allclose(stored(run, step)["state"], before[0], atol=1e-6)
    moved = stored(run, 2)["after"] - stored(run, 3)["state"]
    assert np.abs(moved).max() > 1e-4
    u = stream(0, "exploration", 2, 0).random((DRAW_BLOCK, CHOICES + 12))[2]
    fresh = TARGET.initial(u[CHOICES + 8 :])
    assert np.allclose(stored(run, 3)["state"], fresh, atol=1e-6)


@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("nu", [0.0, 0.998, 1.0])
@pytest.mark.parametrize("step", [0, 700])
def test_the_prior_acts_with_probability_nu_to_the_step(step, nu, epsilon):
    run = run_of(StageInit(prior=Known(5), behavior=PolicyReuse(nu)))
    run.state.step, n = step, 4000
    u = np.random.default_rng(step).random((1, n, 3))
    states = np.zeros((1, n, 4))
    frozen = (np.zeros((1, n, 8)), None, Known(5)(states, 8))
    own, done = run._choose(Known(2)(states, 8), frozen, u, epsilon)
    random, follow = u[0, :, 0] < epsilon, u[0, :, 2] < nu**step
    free = np.where(random, np.floor(8 * u[0, :, 1]), 2)
    assert np.array_equal(done[0], np.where(follow, 5, free))
    assert np.array_equal(own, done)
    assert follow.mean() == pytest.approx(nu**step, abs=0.03)


def test_the_residual_policy_in_a_run():
    """Copies the prior in `offset` greedy decisions; random ones aren't counted."""
    offset, settings = 25, replace(SMALL, random_steps=10, epsilon=0.3)
    prior, n = 4, CHOICES + TARGET.step_noise + TARGET.initial_noise
    behavior = ResidualPolicy(offset)
    run = run_of(StageInit(prior=Known(prior), behavior=behavior), settings)
    draws = stream(0, "exploration", 2, 0).random((DRAW_BLOCK, n))
    table, decided, acted_alone = combined_actions(TARGET.actions), 0, 0
    for step in range(80):
        before, u = run.state.env_state.copy(), draws[step]
        values = run.state.deep(before[:, None], 8)[0, 0]
        run.act()
        run.end_step()
        if u[0] < (1.0 if step < 10 else 0.3):
            own = int(8 * u[1])
        else:
            own = prior if decided < offset else int(values.argmax())
            acted_alone += decided >= offset
            decided += 1
        row = stored(run, step)
        assert row["action"] == own
        noise = u[CHOICES : CHOICES + 8]
        after, _, _ = TARGET.step(before[0], np.array(table[prior, own]), noise)
        assert np.allclose(row["after"], after, atol=1e-6)
        assert run.state.n_greedy_decisions[0] == decided
    assert acted_alone > 10


HALF = SMALL.evaluation_episodes


def evaluated(run, u):
    """What the snapshot's policy does at PATH in all lanes, and the greedy action."""
    at = np.tile(PATH, (1, 2 * HALF, 1))
    done = run.snapshot().policy(at, u, np.ones((1, 2 * HALF), bool))[0]
    return done, run.state.deep(at, 8)[0, 0].argmax()


def test_evaluation_of_the_residual_policy_is_in_the_runs_phase():
    """While copying, greedy lanes do as the prior; afterwards they combine."""
    run = run_of(StageInit(prior=Known(4), behavior=ResidualPolicy(30)))
    u, table = np.random.default_rng(0).random((1, 2 * HALF, 3)), TARGET.actions
    drawn, random = (8 * u[0, :, 1]).astype(int), u[0, :, 0] < 0.1
    random[HALF:] = False
    assert random.any()
    for decided in (0, 30):
        run.state.n_greedy_decisions[:] = decided
        done, best = evaluated(run, u)
        own = np.where(random, drawn, best if decided else 4)
        assert np.array_equal(done, combined_actions(table)[4, own])
        assert (run.state.n_greedy_decisions == decided).all()


def test_evaluation_of_policy_reuse_explores_with_the_prior_and_is_greedy_without():
    run = run_of(StageInit(prior=Known(4), behavior=PolicyReuse(0.9)))
    u, run.state.step = np.random.default_rng(0).random((1, 2 * HALF, 3)), 5
    done, best = evaluated(run, u)
    free = np.where(u[0, :, 0] < 0.1, (8 * u[0, :, 1]).astype(int), best)
    expected = np.where(u[0, :, 2] < 0.9**5, 4, free)
    assert np.array_equal(done[:HALF], expected[:HALF])
    assert (done[HALF:] == best).all() and best != 4


def test_each_transfer_edits_its_own_part_of_the_start():
    q, own = Known(1), Known(2)
    start, reuse = StageInit(StageResult(q, own)), PolicyReuse(0.5)
    boosted = {"base": q, "boost": RELEASED_BOOST}
    shaped = {"potential": q, "shape": RELEASED_SHAPE}
    assert begin((RELEASED_BOOST,), None) == StageInit()  # a first stage
    for transfers, edited in (
        ((), {}),
        ((reuse,), {"prior": q, "behavior": reuse}),
        ((warm_start,), {"initial": own}),
        ((RELEASED_BOOST, RELEASED_SHAPE), boosted | shaped),
    ):
        assert begin(transfers, start.previous) == replace(start, **edited)


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: PolicyReuse(-0.1), "transfer.nu"),
        (lambda: PolicyReuse(math.nan), "transfer.nu"),
        (lambda: ResidualPolicy(-1), "transfer.offset"),
        (lambda: begin([lambda *_: 7], StageResult(ZERO, ZERO)), "transfer"),
    ],
)
def test_impossible_transfers_are_rejected(make, key):
    with pytest.raises(ConfigError) as error:
        make()
    assert error.value.key == key


def test_a_warm_start_continues_with_all_but_the_replay():
    settings = replace(SMALL, steps=90, learning_starts=20, target_update=25)
    first = staged(settings, LinearSystem("lq", horizon=100))
    result = last(settings.learn(first, StageInit(), team(0, 1))).result
    old = deepcopy(result.residual)
    assert old.steps == 90 and old.optimiser.steps == 70
    assert not torch.equal(old.online.flat, old.target.flat)
    run = run_of(begin([warm_start], result), settings, seeds=(0, 1))
    deep, replay = run.state.deep, run.state.replay

    def trained_parts(of):
        return torch.stack([of.online.flat, of.target.flat, *of.optimiser.moments])

    assert torch.equal(trained_parts(deep), trained_parts(old))
    assert (deep.steps, deep.optimiser.steps) == (90, 70) and replay.size == 0
    for step in range(25):  # step 100 copies the target, after 10 here
        run.act()
        if replay.size > 20:
            run.update()
        run.end_step()
        assert torch.equal(deep.target.flat, old.online.flat) == (step >= 9)
    assert not torch.equal(deep.online.flat, old.online.flat)
    assert torch.equal(trained_parts(result.residual), trained_parts(old))  # untouched


def test_a_boosted_stage_starts_with_new_networks_on_a_frozen_sum():
    settings = replace(SMALL, steps=40, learning_starts=10)
    first = last(settings.learn(staged(settings, TARGET), StageInit(), team(0))).result
    run = run_of(begin([Boost()], first), settings)
    deep = run.state.deep
    assert not torch.equal(deep.online.flat, first.residual.online.flat)
    assert (deep.steps, deep.optimiser.steps) == (0, 0)
    assert run.snapshot().result.q == Sum((first.q, deep))
