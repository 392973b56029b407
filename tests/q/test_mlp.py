"""The stacked networks and both updates against torch's own modules and optimiser."""

import itertools
import math
from copy import deepcopy

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_limits
from torch.nn import functional

from bcrl.common.seeding import stream
from bcrl.errors import BcrlError
from bcrl.learning.replay import Replay, batched, one_by_one
from bcrl.q.networks import cpu
from bcrl.q.networks.mlp import Adam, DeepQ, Networks, xavier

D, A, BATCH = 4, 8, 32
HIDDEN = pytest.mark.parametrize("hidden", [(128, 128), (64,), (33, 20, 7)])
WAYS = pytest.mark.parametrize("way", [batched, one_by_one])


@pytest.fixture(autouse=True)
def one_thread():
    """As DQN runs them: threads only get into each other's way here."""
    with threadpool_limits(1):
        yield


def networks(hidden, seeds, purpose="weights"):
    sizes = (D, *hidden, A)
    drawn = [xavier(stream(seed, purpose, 1), sizes) for seed in seeds]
    return Networks(sizes, torch.from_numpy(np.stack(drawn)))


def learner(hidden, seeds, rate=1e-4):
    """Networks whose target differs from the online ones."""
    online = networks(hidden, seeds)
    optimiser = Adam.of(online.flat, rate)
    return DeepQ(online, networks(hidden, seeds, "trees"), optimiser, 0)


def filled(seeds, n=200, capacity=200):
    """A replay of random rows, each seed's own; a tenth of them absorbing."""
    replay, parts = Replay.empty(len(seeds), capacity, D, A, "cpu"), []
    for seed in seeds:
        rng = stream(seed, "data")
        states, base = rng.standard_normal((2, n, D)) * 2.0, rng.standard_normal((n, A))
        fixed = rng.standard_normal(n) * 2.0  # errors on both sides of 1
        discount = np.where(rng.random(n) < 0.1, 0.0, 0.99)
        parts.append((*states, base, fixed, discount, rng.integers(A, size=n)))
    stacked = [np.stack(column, 1) for column in zip(*parts, strict=True)]
    for i in range(n):
        replay.add(*(column[i] for column in stacked))
    return replay


def indices(seeds, steps, n=200, batch=BATCH):
    picked = [stream(s, "replay").integers(n, size=(steps, batch)) for s in seeds]
    return np.stack(picked, 1)


NEXT = np.random.default_rng(1).standard_normal((8, D))


def losses_of(update, chosen):
    """The losses of one update."""
    return update(chosen[None], NEXT[: len(chosen)])[0]


def module(networks, s):
    """Seed s's network as torch's own."""
    layers = []
    for weights, biases in networks.layers:
        linear = torch.nn.Linear(*weights.shape[1:])
        linear.weight.data = weights[s].T.clone()
        linear.bias.data = biases[s, 0].clone()
        layers += [linear, torch.nn.ReLU()]
    return torch.nn.Sequential(*layers[:-1])


def flattened(module, of=lambda p: p):
    """Its parameters in the order of `Networks`: weights (in, out), then biases."""
    linear = [x for x in module if isinstance(x, torch.nn.Linear)]
    parts = [(of(x.weight).T.flatten(), of(x.bias)) for x in linear]
    return torch.cat([x.detach() for pair in parts for x in pair])


def loss_of(online, target, rows):
    """torch's loss of one seed's rows (B, width), unpacked by hand."""
    state, after, base = rows[:, :D], rows[:, D : 2 * D], rows[:, 2 * D : 2 * D + A]
    fixed, discount, action = rows[:, -3], rows[:, -2], rows[:, -1].long()
    with torch.no_grad():
        y = fixed + discount * (target(after) + base).max(1).values
    values = online(state)[torch.arange(len(rows)), action]
    return functional.smooth_l1_loss(values, y)


@WAYS
@pytest.mark.parametrize(
    ("hidden", "batch"), [((128, 128), BATCH), ((64,), 19), ((33, 20, 7), 70)]
)
def test_gradients_and_adam_are_torchs(way, hidden, batch):
    seeds, steps = (0, 1, 5), 10
    deep, replay = learner(hidden, seeds), filled(seeds)
    at = indices(seeds, steps, batch=batch)
    single = [(module(deep.online, s), module(deep.target, s)) for s in range(3)]
    adams = [
        torch.optim.Adam(one.parameters(), 1e-4, betas=(0.9, 0.999), eps=1e-8)
        for one, _ in single
    ]
    update = way(deep, replay)
    for step in range(steps):
        losses = losses_of(update, at[step])
        for s, (one, target) in enumerate(single):
            loss = loss_of(one, target, replay.rows[s, at[step, s]])
            adams[s].zero_grad()
            loss.backward()
            if step == 0:
                gradient = deep.optimiser.moments[0, s] / 0.1
                expected = flattened(one, lambda p: p.grad)
                assert (expected.abs() > 1e-3).any()
                assert torch.allclose(gradient, expected, rtol=1e-4, atol=1e-6)
            adams[s].step()
            assert losses[s] == pytest.approx(loss.item(), rel=1e-5)
            off = (deep.online.flat[s] - flattened(one)).abs().max()
            assert off < 1e-6, (step, s)
            assert torch.equal(deep.target.flat[s], flattened(target))


@WAYS
def test_an_update_uses_the_current_target_and_the_current_rows(way):
    """Bootstrap values are cached until the target is copied or a row overwritten."""
    seeds, steps = (0, 1), 9
    deep, replay = learner((16,), seeds, rate=0.05), filled(seeds)
    at = indices(seeds, steps, n=20)  # the same rows again and again
    other = filled((7, 8)).rows
    update = way(deep, replay)
    for step in range(steps):
        if step in (3, 6):
            deep.target.flat.copy_(deep.online.flat)
            replay.valid[:] = False
        if step == 5:  # the oldest rows are overwritten, the rest of the ring too
            for i in range(replay.capacity):
                cut = np.cumsum([D, D, A, 1, 1])
                parts = np.split(other[:, i % 200].numpy(), cut, axis=1)
                *arrays, fixed, discount, action = parts
                replay.add(*arrays, fixed[:, 0], discount[:, 0], action[:, 0])
        now = [(module(deep.online, s), module(deep.target, s)) for s in range(2)]
        # The first batch of a target's time comes with those of the rest of it.
        batches = at[step : 3 * (step // 3 + 1)] if step in (0, 3, 6) else at[[step]]
        losses, _ = update(batches, NEXT[:2])
        for s, (online, target) in enumerate(now):
            expected = loss_of(online, target, replay.rows[s, at[step, s]]).item()
            assert losses[s] == pytest.approx(expected, rel=1e-4), (step, s)


@HIDDEN
def test_the_stacked_forward_pass_is_torchs(hidden):
    many, rng = networks(hidden, (0, 3)), torch.Generator().manual_seed(0)
    x, sizes = torch.randn(2, 7, D, generator=rng), np.array(many.sizes)
    compiled = cpu.outputs(many.flat.numpy(), sizes, x.numpy())
    for s in range(2):
        expected = module(many, s)(x[s]).detach()
        assert torch.allclose(many.forward(x)[s], expected, atol=1e-5)
        assert np.allclose(compiled[s], expected, atol=1e-5)


@WAYS
@HIDDEN
def test_stacking_changes_no_bit(way, hidden):
    def trained(seeds):
        deep, at = learner(hidden, seeds), indices(seeds, 20)
        update = way(deep, filled(seeds))
        losses = np.array([losses_of(update, now) for now in at])
        return losses, deep.online.flat, deep.optimiser.moments

    losses, flat, moments = trained((3, 4, 5, 6, 7))
    for s in (0, 3):
        own, one, of_one = trained((3 + s,))
        assert np.array_equal(own[:, 0], losses[:, s])
        assert torch.equal(one[0], flat[s])
        assert torch.equal(of_one[:, 0], moments[:, s])


@HIDDEN
def test_the_compiled_update_gives_the_new_networks_next_values(hidden):
    deep, replay, at = learner(hidden, (0, 1)), filled((0, 1)), indices((0, 1), 1)
    _, next_values = one_by_one(deep, replay)(at, NEXT[:2])
    assert np.array_equal(next_values, deep(NEXT[:2, None], A)[:, 0])


@HIDDEN
def test_weights_and_biases_fill_their_boxes(hidden):
    sizes = (D, *hidden, A)
    drawn = np.stack([xavier(stream(s, "weights", 1), sizes) for s in range(40)])
    at = 0
    for n_in, n_out in itertools.pairwise(sizes):
        gain = 1.0 if n_out == A else math.sqrt(2.0)
        weights = n_in * n_out, gain * math.sqrt(6.0 / (n_in + n_out))
        for n, bound in (weights, (n_out, 1.0 / math.sqrt(n_in))):
            part, at = drawn[:, at : at + n], at + n
            assert 0.97 * bound < np.abs(part).max() <= bound * (1.0 + 1e-6)
            assert part.std() == pytest.approx(bound / math.sqrt(3.0), rel=0.1)
            assert abs(part.mean()) < 0.15 * bound
    assert at == drawn.shape[1]
    assert len(np.unique(drawn[:, 0])) == 40


@WAYS
def test_a_gradient_that_is_no_number_is_seen_in_the_weights(way):
    deep, replay = learner((16,), (0, 1)), filled((0, 1))
    replay.rows[1, :, -3] = math.nan
    losses = losses_of(way(deep, replay), indices((0, 1), 1)[0])
    assert math.isfinite(losses[0]) and math.isnan(losses[1])
    assert deep.online.flat[0].isfinite().all()
    assert deep.online.flat[1].isnan().any()


@pytest.mark.parametrize("n", [50, 64, 150])
def test_adam_is_the_papers_and_faded_moments_become_zero(n):
    smallest, rng = np.finfo(np.float32).tiny, np.random.default_rng(0)
    parameters = rng.standard_normal(n).astype(np.float32)
    first, second = np.zeros((2, n), np.float32)
    optimiser = Adam.of(torch.zeros(1, n), 1e-4)
    x, m, v = parameters.astype(float), np.zeros(n), np.zeros(n)
    gradient = (10.0 ** rng.uniform(-14, 0, n)).astype(np.float32)
    for step in range(1, 3001):
        now = gradient if step <= 3 else np.zeros_like(gradient)
        cpu.step_of_adam(parameters, first, second, now, optimiser.next_step())
        for moment in (first, second):
            assert not ((moment != 0) & (np.abs(moment) < smallest)).any()
        m, v = 0.9 * m + 0.1 * now, 0.999 * v + 0.001 * now.astype(float) ** 2
        spread = np.sqrt(v / (1.0 - 0.999**step)) + 1e-8
        x -= 1e-4 * m / (1.0 - 0.9**step) / spread
    assert not first.any()
    assert np.abs(parameters - x).max() < 1e-6


def test_a_deep_q_answers_stacked_and_listed_states_alike():
    deep = learner((32, 32), (0, 1))
    states = np.random.default_rng(0).standard_normal((2, 9, D))
    stacked, listed = deep(states, A), deep([states[0], states[1, :4]], A)
    assert stacked.dtype == np.float64 and stacked.shape == (2, 9, A)
    for one, other in zip((stacked[0], stacked[1, :4]), listed, strict=True):
        assert np.allclose(one, other, atol=1e-6)
    for wrong in (states[..., :3], states[:1], [*states, states[0]]):
        with pytest.raises(BcrlError, match=r"4 entries.* 3;|2 seeds.* [13];"):
            deep(wrong, A)


def test_a_clone_trains_on_its_own():
    deep, replay = learner((16,), (0, 1)), filled((0, 1))
    losses_of(one_by_one(deep, replay), indices((0, 1), 1)[0])
    copy = deepcopy(deep)
    kept = deepcopy((deep.online.flat, deep.target.flat, deep.optimiser.moments))
    assert torch.equal(copy.optimiser.moments, kept[2]) and copy.optimiser.steps == 1
    losses_of(one_by_one(copy, replay), indices((0, 1), 1)[0])
    copy.target.flat.zero_()
    now = deep.online.flat, deep.target.flat, deep.optimiser.moments
    assert all(torch.equal(a, b) for a, b in zip(now, kept, strict=True))
    assert not torch.equal(copy.online.flat, deep.online.flat)
    assert deep.optimiser.steps == 1
