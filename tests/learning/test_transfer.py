"""What each transfer does to targets, rewards and actions, by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bcrl.common.seeding import stream
from bcrl.envs.linear_system import LinearSystem
from bcrl.errors import ConfigError
from bcrl.evaluation.step_metrics import evaluate
from bcrl.learning.bellman import precompute_target, residual_target, shaping
from bcrl.learning.dqn import DQN
from bcrl.learning.lockstep import BLOCK, CHOICES, DQNTrainer
from bcrl.learning.lspi import LSPI
from bcrl.learning.policies import combined
from bcrl.learning.rollout import transition_tables
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
from bcrl.q.functions import ZERO, Shaped, Sum, Table
from tests.toys import Corridor, last, staged, team

TARGET = LinearSystem()
RELEASED_BOOST = Boost("residual", "two", False)
RELEASED_SHAPE = Shape("before_reset", False)
SMALL = DQN(hidden=(16,), random_steps=0, steps=100, learning_starts=1000)

# Three transitions, the second absorbing; γ = 0.9.
REWARD = np.array([-1.0, 0.0, 2.0])
ABSORBING = np.array([False, True, False])
NEXT_BASE = np.array([[1.0, 3.0], [2.0, 5.0], [-4.0, -1.0]])
NEXT_RESIDUAL = np.array([[2.0, -1.0], [1.0, 1.0], [0.0, 3.0]])
BASE = np.array([0.5, 0.25, -2.0])


def target(base, next_base, boost):
    fixed, discount, inside = precompute_target(
        REWARD, ABSORBING, next_base, base, 0.9, boost.maxima, boost.mask_at_goal
    )
    return fixed + discount * (NEXT_RESIDUAL + inside).max(-1)


@pytest.mark.parametrize(
    ("boost", "expected"),
    [
        # max of the sum: 3, –, 2; sum of the maxima: 2 + 3, –, 3 − 1
        (Boost(), [-1 + 2.7 - 0.5, -0.25, 2 + 1.8 + 2]),
        (Boost(greedy_on="residual"), [1.2, -0.25, 5.8]),
        (Boost(maxima="two"), [-1 + 4.5 - 0.5, -0.25, 5.8]),
        (Boost(mask_at_goal=False), [1.2, 4.5 - 0.25, 5.8]),
        (RELEASED_BOOST, [3.0, 4.25, 5.8]),
    ],
)
def test_the_target_of_each_boost_by_hand(boost, expected):
    assert target(BASE, NEXT_BASE, boost).tolist() == pytest.approx(expected)


@pytest.mark.parametrize("boost", [Boost(), RELEASED_BOOST])
def test_without_a_base_every_boost_is_the_plain_target(boost):
    plain = target(np.zeros(3), np.zeros((3, 2)), boost)
    assert plain.tolist() == pytest.approx([-1 + 1.8, 0.0, 2 + 2.7])


def test_one_maximum_and_the_mask_are_equation_5():
    whole = NEXT_BASE + NEXT_RESIDUAL
    expected = residual_target(REWARD, ABSORBING, whole, BASE, 0.9)
    assert np.allclose(target(BASE, NEXT_BASE, Boost()), expected)


def test_the_released_boost_is_advice_on_the_reward():
    """DQN on r + γ V(s') − base(s, a), the base counting at the goal, too."""
    advised = REWARD + 0.9 * NEXT_BASE.max(-1) - BASE
    alone = advised + 0.9 * np.where(ABSORBING, 0.0, NEXT_RESIDUAL.max(-1))
    assert np.allclose(target(BASE, NEXT_BASE, RELEASED_BOOST), alone)


def test_the_shaping_term_by_hand():
    value, after = np.array([4.0, 4.0]), np.array([6.0, 6.0])
    done = np.array([False, True])
    masked = shaping(value, after, done, 0.5, True)
    assert masked.tolist() == [0.5 * 6 - 4, -4.0]
    assert shaping(value, after, done, 0.5, False).tolist() == [-1.0, -1.0]


class Known:
    """V(s) = 7 x + 3 y + 40, and Q(s, a) = V(s) − distance of a to the `best`."""

    def __init__(self, best=0):
        self.best = best

    def __call__(self, states, n_actions):
        x = np.asarray(states)
        value = 7.0 * x[..., 0] + 3.0 * x[..., 2] + 40.0
        return value[..., None] - np.abs(np.arange(n_actions) - self.best)


def value(state):
    return 7.0 * state[0] + 3.0 * state[2] + 40.0


def run_of(start, settings=SMALL, env=TARGET, seeds=(0,), number=2):
    return DQNTrainer(settings, staged(settings, env, number), start, team(*seeds))


def put(run, state):
    """Move the mass of a single seed's run."""
    run.state = np.array([state], float)
    run.known = run._known(run.state)


def stored(run, at=0):
    """The first seed's row in the replay, by name."""
    row = run.replay.rows[0, at].double().numpy()
    d, n = run.env.state_dim, run.env.n_actions
    parts = np.split(row, [d, 2 * d, 2 * d + n, 2 * d + n + 1, 2 * d + n + 2])
    names = ("state", "after", "next_base", "fixed", "discount", "action")
    return {k: v if len(v) > 1 else v[0] for k, v in zip(names, parts, strict=True)}


PATH = (-2.0, 0.0, 0.1, 0.0)
FALLING = (-2.0, 0.0, 0.45, 3.0)  # y = 0.6 after a step
ARRIVING = (-0.25, 2.5, 0.0, 0.0)  # x = -0.15 after a step
FALL_ROW = (-2.0 - 0.5 * 0.05, 0.0, 0.45 + 3.0 * 0.05, 0.0)  # where FALLING leads


@pytest.mark.parametrize("shape", [Shape(), RELEASED_SHAPE, Shape("before_reset")])
@pytest.mark.parametrize("at", [PATH, FALLING, ARRIVING])
def test_the_shaped_reward_of_a_step(shape, at):
    run = run_of(StageInit(potential=Known(), shape=shape))
    put(run, at)
    run.act()
    row = stored(run)
    absorbing = at == ARRIVING
    reward = 0.0 if absorbing else -1.0
    leads_to = row["after"]
    if at == FALLING:
        assert leads_to[0] == pytest.approx(-4.0, abs=2e-3)  # the fresh start is stored
        if shape.next_state == "before_reset":
            leads_to = FALL_ROW
    after = 0.0 if absorbing and shape.zero_at_goal else value(leads_to)
    expected = reward + 0.99 * after - value(at)
    assert row["fixed"] == pytest.approx(expected, abs=1e-4)
    assert row["discount"] == pytest.approx(0.0 if absorbing else 0.99)
    assert not row["next_base"].any()


def test_falling_costs_the_way_back_unless_shaping_looks_before_the_reset():
    rewards = []
    for shape in (Shape(), RELEASED_SHAPE):
        run = run_of(StageInit(potential=Known(), shape=shape))
        put(run, FALLING)
        run.act()
        rewards.append(stored(run)["fixed"])
    assert rewards[0] < rewards[1] - 10.0


@pytest.mark.parametrize("at", [PATH, FALLING, ARRIVING])
@pytest.mark.parametrize("boost", [Boost(), RELEASED_BOOST, Boost(maxima="two")])
def test_what_a_boosted_step_stores(at, boost):
    run = run_of(StageInit(base=Known(best=3), boost=boost))
    put(run, at)
    run.act()
    row = stored(run)
    base = value(at) - abs(row["action"] - 3)
    absorbing = at == ARRIVING
    next_values = value(row["after"]) - np.abs(np.arange(8) - 3)
    residual = np.linspace(-2.0, 3.0, 8)
    whole = residual + next_values
    bootstrap = whole.max()
    if boost.maxima == "two":
        bootstrap = residual.max() + next_values.max()
    if absorbing:
        bootstrap = 0.0 if boost.mask_at_goal else next_values.max()
    expected = (0.0 if absorbing else -1.0) + 0.99 * bootstrap - base
    found = row["fixed"] + row["discount"] * (residual + row["next_base"]).max()
    assert found == pytest.approx(expected, abs=1e-4)


def test_shaping_and_boosting_together_store_both():
    run = run_of(StageInit(base=Known(3), potential=Known(), shape=Shape()))
    put(run, PATH)
    run.act()
    row = stored(run)
    shaped = -1.0 + 0.99 * value(row["after"]) - value(PATH)
    base = value(PATH) - abs(row["action"] - 3)
    assert row["fixed"] == pytest.approx(shaped - base, abs=1e-4)
    learned = run.moment().learned
    asked = np.array([[PATH]])
    raised = run.deep(asked, 8) + Known(3)(asked, 8) + value(PATH)
    assert np.allclose(learned.q(asked, 8), raised)
    assert learned.residual is run.deep


def test_the_horizons_end_is_bootstrapped_from_and_starts_anew():
    run = run_of(StageInit(), env=replace(TARGET, horizon=3))
    for step in range(4):
        before = run.state.copy()
        run.act()
        run.end_step()
        assert stored(run, step)["discount"] == pytest.approx(0.99)
        assert np.allclose(stored(run, step)["state"], before[0], atol=1e-6)
    moved = stored(run, 2)["after"] - stored(run, 3)["state"]
    assert np.abs(moved).max() > 1e-4
    u = stream(0, "exploration", 2, 0).random((BLOCK, CHOICES + 12))[2]
    fresh = TARGET.initial(u[CHOICES + 8 :])
    assert np.allclose(stored(run, 3)["state"], fresh, atol=1e-6)


# --- residual policy and policy reuse ---


def by_brute_force(actions, prior, own):
    x, y = (a + b for a, b in zip(actions[prior], actions[own], strict=True))
    if math.hypot(x, y) < 1e-6:
        return own

    def distance(a, to):
        return round(math.hypot(a[0] - to[0], a[1] - to[1]), 6)

    rank = [(distance(a, (x, y)), distance(a, actions[own])) for a in actions]
    assert rank.count(min(rank)) == 1  # both rules together leave no choice
    return rank.index(min(rank))


def test_the_residual_policys_table_is_a_brute_force_searchs():
    actions = TARGET.actions.tolist()
    table = combined(TARGET.actions)
    for prior, own in np.ndindex(8, 8):
        assert table[prior, own] == by_brute_force(actions, prior, own)


@pytest.mark.parametrize(
    ("prior", "own", "done"),
    [
        ((1, 0), (0, 1), (1, 1)),
        ((1, 0), (-1, 0), (-1, 0)),  # they cancel
        ((1, 1), (-1, -1), (-1, -1)),
        ((1, 0), (1, 0), (1, 0)),
        ((1, 0), (-1, 1), (0, 1)),  # at 67.5°, between (0, 1) and (1, 1)
        ((-1, 1), (1, 0), (1, 1)),  # the same sum, the other own action
        ((0, 1), (1, 1), (1, 1)),
    ],
)
def test_combined_actions_by_hand(prior, own, done):
    units = [np.array(v) / math.hypot(*v) for v in (prior, own, done)]
    index = [int(np.abs(TARGET.actions - v).sum(1).argmin()) for v in units]
    assert combined(TARGET.actions)[index[0], index[1]] == index[2]


def n_greedy_decisions(run, step, epsilon, n=4000, best_own=2):
    """Own and executed actions of n decisions with their uniforms."""
    u = np.random.default_rng(step).random((1, n, 3))
    own_values = np.broadcast_to(-np.abs(np.arange(8.0) - best_own), (1, n, 8))
    prior_values = np.broadcast_to(-np.abs(np.arange(8.0) - 5), (1, n, 8))
    own, done = run._decide(own_values, prior_values, u, epsilon, step)
    return u[0], own[0], done[0]


@pytest.mark.parametrize("epsilon", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(("nu", "step"), [(1.0, 0), (1.0, 5000), (0.0, 0)])
def test_reused_policies_act_whatever_epsilon(nu, step, epsilon):
    run = run_of(StageInit(prior=Known(5), behavior=PolicyReuse(nu)))
    _, own, done = n_greedy_decisions(run, step, epsilon)
    assert (own == 5).all() and (done == 5).all()


@pytest.mark.parametrize("step", [1, 700])
def test_the_prior_acts_with_probability_nu_to_the_step(step):
    for nu in (0.0, 0.998):
        run = run_of(StageInit(prior=Known(5), behavior=PolicyReuse(nu)))
        u, own, done = n_greedy_decisions(run, step, epsilon=0.3)
        random, follow = u[:, 0] < 0.3, u[:, 2] < nu**step
        free = np.where(random, np.floor(8 * u[:, 1]), 2)
        assert np.array_equal(done, np.where(follow, 5, free))
        assert np.array_equal(own, done)
        assert follow.mean() == pytest.approx(nu**step, abs=0.03)


def test_policy_reuse_in_a_run():
    """ν = 1: the prior's greedy action is executed and stored in every step."""
    settings = replace(SMALL, random_steps=20, epsilon=0.5)
    run = run_of(StageInit(prior=Known(4), behavior=PolicyReuse(1.0)), settings)
    for step in range(40):
        run.act()
        run.end_step()
        assert stored(run, step)["action"] == 4


def test_the_residual_policy_in_a_run():
    """Copies the prior for `offset` decisions; random ones aren't counted."""
    offset, settings = 25, replace(SMALL, random_steps=10, epsilon=0.3)
    prior, n = 4, CHOICES + TARGET.step_noise + TARGET.initial_noise
    run = run_of(
        StageInit(prior=Known(prior), behavior=ResidualPolicy(offset)), settings
    )
    draws = stream(0, "exploration", 2, 0).random((BLOCK, n))
    table, decided, acted_alone = combined(TARGET.actions), 0, 0
    for step in range(80):
        before, u = run.state.copy(), draws[step]
        values = run.deep(before[:, None], 8)[0, 0]
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
        assert run.n_greedy_decisions[0] == decided
    assert acted_alone > 10


@pytest.mark.parametrize("behavior", [PolicyReuse(0.9), ResidualPolicy(30)])
def test_evaluating_advances_no_counter(behavior):
    run = run_of(
        StageInit(prior=Known(4), behavior=behavior), replace(SMALL, epsilon=0.3)
    )
    for _ in range(20):
        run.act()
        run.end_step()
    seen = run.n_greedy_decisions.copy(), run.deep.steps, run.replay.added
    kept = run.state.copy()
    first = evaluate(run.moment(), (0,))
    assert (run.n_greedy_decisions == seen[0]).all()
    assert (run.deep.steps, run.replay.added) == seen[1:]
    assert np.array_equal(run.state, kept)
    assert str(first) == str(evaluate(run.moment(), (0,)))


def test_evaluation_of_the_residual_policy_is_in_the_runs_phase():
    """While copying, greedy lanes do as the prior; afterwards they combine."""
    run = run_of(StageInit(prior=Known(4), behavior=ResidualPolicy(30)))
    lanes = 2 * SMALL.evaluation_episodes
    at = np.broadcast_to(np.array(PATH), (1, lanes, 4)).copy()
    u = np.random.default_rng(0).random((1, lanes, 3))
    policy, half = run.moment().policy, SMALL.evaluation_episodes
    alive = np.ones((1, lanes), bool)
    table, best = combined(TARGET.actions), run.deep(at, 8)[0, 0].argmax()
    drawn, random = (8 * u[0, :, 1]).astype(int), u[0, :, 0] < 0.1
    random[half:] = False
    for own, decided in ((4, 0), (best, 30)):
        run.n_greedy_decisions[:] = decided
        expected = table[4, np.where(random, drawn, own)]
        assert np.array_equal(policy(at, u, alive)[0], expected)
    assert random.any()


def test_evaluation_of_policy_reuse_explores_with_the_prior_and_is_greedy_without():
    run = run_of(StageInit(prior=Known(4), behavior=PolicyReuse(0.9)))
    half = SMALL.evaluation_episodes
    at = np.broadcast_to(np.array(PATH), (1, 2 * half, 4)).copy()
    u = np.random.default_rng(0).random((1, 2 * half, 3))
    run.step = 5
    found = run.moment().policy(at, u, np.ones((1, 2 * half), bool))[0]
    best = run.deep(at, 8)[0, 0].argmax()
    free = np.where(u[0, :, 0] < 0.1, (8 * u[0, :, 1]).astype(int), best)
    expected = np.where(u[0, :, 2] < 0.9**5, 4, free)
    assert np.array_equal(found[:half], expected[:half])
    assert (found[half:] == best).all() and best != 4


# --- what a stage starts from ---


@pytest.mark.parametrize(
    "transfer",
    [Boost(), RELEASED_BOOST, Shape(), PolicyReuse(), ResidualPolicy(), warm_start],
)
def test_nothing_is_transferred_into_a_first_stage(transfer):
    assert begin([transfer], None) == StageInit()


def test_each_transfer_edits_its_own_part_of_the_start():
    previous = StageResult(Known(1), Known(2))
    plain = StageInit(previous)
    assert begin([], previous) == plain
    boosted = begin([RELEASED_BOOST], previous)
    assert boosted == replace(plain, base=previous.q, boost=RELEASED_BOOST)
    shape, reuse, rpl = RELEASED_SHAPE, PolicyReuse(0.5), ResidualPolicy(7)
    shaped = begin([shape], previous)
    assert shaped == replace(plain, potential=previous.q, shape=shape)
    for behavior in (reuse, rpl):
        steered = begin([behavior], previous)
        assert steered == replace(plain, prior=previous.q, behavior=behavior)
    warm = begin([warm_start], previous)
    assert warm == replace(plain, initial=previous.residual)
    both = begin([Boost(), Shape()], previous)
    assert (both.base, both.potential) == (previous.q, previous.q)
    assert both.shape == Shape() and both.initial is ZERO


@pytest.mark.parametrize("bad", [-0.1, 1.1, math.nan])
def test_an_impossible_nu_is_refused(bad):
    with pytest.raises(ConfigError, match=r"transfer\.nu"):
        PolicyReuse(bad)


def test_a_negative_offset_is_refused():
    with pytest.raises(ConfigError, match=r"transfer\.offset"):
        ResidualPolicy(-1)


def test_a_warm_start_goes_on_with_all_but_the_replay():
    settings = replace(SMALL, steps=90, learning_starts=20, target_update=25)
    first = staged(settings, LinearSystem("lq", horizon=100))
    learned = last(settings.learn(first, StageInit(), team(0, 1))).learned
    old = learned.residual.clone()
    assert old.steps == 90 and old.optimiser.steps == 70
    assert not torch.equal(old.online.flat, old.target.flat)
    run = run_of(begin([warm_start], learned), settings, seeds=(0, 1))
    for a, b in (
        (run.deep.online.flat, old.online.flat),
        (run.deep.target.flat, old.target.flat),
        (run.deep.optimiser.moments, old.optimiser.moments),
    ):
        assert torch.equal(a, b)
    assert (run.deep.steps, run.deep.optimiser.steps) == (90, 70)
    assert run.replay.size == 0 and not run.replay.rows.any()
    for step in range(25):  # step 100 copies the target, after 10 here
        run.act()
        if run.replay.size > 20:
            run.update()
        run.end_step()
        assert torch.equal(run.deep.target.flat, old.online.flat) == (step >= 9)
    assert not torch.equal(run.deep.online.flat, old.online.flat)
    assert torch.equal(learned.residual.online.flat, old.online.flat)  # untouched
    assert torch.equal(learned.residual.optimiser.moments, old.optimiser.moments)


def test_a_boosted_stage_starts_with_new_networks_on_a_frozen_sum():
    settings = replace(SMALL, steps=40, learning_starts=10)
    first = last(settings.learn(staged(settings, TARGET), StageInit(), team(0))).learned
    run = run_of(begin([Boost()], first), settings)
    assert not torch.equal(run.deep.online.flat, first.residual.online.flat)
    assert (run.deep.steps, run.deep.optimiser.steps) == (0, 0)
    q = run.moment().learned.q
    assert isinstance(q, Sum) and q.terms == (first.q, run.deep)
    x = np.array([[PATH]])
    assert np.allclose(q(x, 8), first.q(x, 8) + run.deep(x, 8))


# --- shaping's invariance (Ng et al. 1999) ---


def value_iteration(index, reward, absorbing, gamma):
    q = np.zeros(reward.shape)
    for _ in range(600):
        after = np.where(absorbing, 0.0, q.max(1)[index])
        q = reward + gamma * after
    return q


@pytest.mark.parametrize("seed", range(5))
def test_shaping_shifts_q_by_minus_v_and_keeps_the_greedy_policy(seed):
    env = Corridor(prize=2.0)
    index, reward, absorbing = transition_tables(env)
    v = np.random.default_rng(seed).standard_normal(6) * 5.0
    extra = shaping(np.repeat(v[:, None], 2, 1), v[index], absorbing, env.gamma, True)
    plain = value_iteration(index, reward, absorbing, env.gamma)
    shaped = value_iteration(index, reward + extra, absorbing, env.gamma)
    assert np.allclose(shaped, plain - v[:, None], atol=1e-9)
    assert np.array_equal(shaped.argmax(1), plain.argmax(1))
    tables = (Table([t], env) for t in (shaped, np.repeat(v[:, None], 2, 1)))
    assert np.allclose(Shaped(ZERO, *tables)([env.states()], 2)[0], plain, atol=1e-9)


def test_shaping_that_is_not_zero_at_the_goal_may_change_the_policy():
    env = Corridor(prize=0.1)
    index, reward, absorbing = transition_tables(env)
    v = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -20.0])
    extra = shaping(np.repeat(v[:, None], 2, 1), v[index], absorbing, env.gamma, False)
    shaped = value_iteration(index, reward + extra, absorbing, env.gamma)
    assert shaped[4].argmax() == 0  # away from the goal
    assert value_iteration(index, reward, absorbing, env.gamma)[4].argmax() == 1


def test_lspis_q_is_a_prior():
    """Its greedy action on the path is to push towards the goal."""
    learner = LSPI()
    env = LinearSystem("lq", horizon=100)
    learned = last(learner.learn(staged(learner, env), StageInit(), team(0))).learned
    start = begin([PolicyReuse(1.0)], learned)
    run = run_of(start)
    put(run, (-4.0, 0.0, 0.0, 0.0))
    run.act()
    done = int(stored(run)["action"])
    assert TARGET.actions[done].tolist() == [1.0, 0.0]


class Counting:
    """A Q-function that counts how often it is asked."""

    def __init__(self):
        self.asked = 0

    def __call__(self, states, n_actions):
        self.asked += 1
        return [np.ones((len(x), n_actions)) for x in states]


def test_stages_stacked_with_shaping_and_boosting_are_asked_once_each():
    first, states = Counting(), [np.zeros((3, 1))]
    q = first
    for _ in range(10):
        q = Shaped(q, ZERO, q)
    assert (q(states, 2)[0] == 2.0**10).all() and first.asked == 1


@pytest.mark.parametrize("stacked", [True, False])
def test_a_remembered_q_is_the_same_q_asked_once_a_state(stacked):
    asked = []

    def q(states, n_actions):
        asked.extend(len(x) for x in states)
        return [np.repeat(x[:, :1], n_actions, 1) for x in states]

    start = StageInit(base=q).memoized()
    assert start.potential is ZERO and StageInit().memoized() == StageInit()
    states = np.random.default_rng(0).normal(size=(2, 4, 3))
    for rows in (slice(0, 2), slice(1, 4), slice(0, 0), slice(0, 4)):
        now = states[:, rows] if stacked else [x[rows] for x in states]
        for x, values in zip(now, start.base(now, 2), strict=True):
            assert values.shape == (len(x), 2) and (values == x[:, :1]).all()
    assert sum(asked) == 8  # four states of either seed
