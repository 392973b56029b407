"""The paper's bounds on random finite MDPs, where all of their terms are exact."""

import numpy as np
import pytest

from research.bounds import (
    accumulated,
    corollary_1,
    estimation,
    lemma_2,
    lemma_3,
    lipschitz,
    lipschitz_limit,
    mean_square,
    propagation,
    ratio,
    sup,
    theorem_2,
)

STATES, ACTIONS, STEPS = 12, 3, 15
EXACT = 1e-8


class Mdp:
    """A random MDP; `stochastic`: its next states are."""

    def __init__(self, seed, gamma=0.9, stochastic=True):
        rng = np.random.default_rng(seed)
        self.gamma, self.reward = gamma, rng.normal(size=(STATES, ACTIONS))
        p = rng.dirichlet(np.full(STATES, 0.3), size=(STATES, ACTIONS))
        if not stochastic:
            p = np.eye(STATES)[rng.integers(STATES, size=(STATES, ACTIONS))]
        self.transitions, self.rng = p, rng
        mu = rng.dirichlet(np.ones(STATES * ACTIONS)) + 0.002
        self.mu = (mu / mu.sum()).reshape(STATES, ACTIONS)

    def __call__(self, q):
        return self.reward + self.gamma * self.transitions @ q.max(-1)

    def optimum(self):
        q = np.zeros((STATES, ACTIONS))
        for _ in range(600):
            q = self(q)
        return q

    def learned(self, noise):
        """Q^k, ϱ^k and ε^k of value iteration on a base with an inexact regressor."""
        q0 = self.rng.normal(size=(STATES, ACTIONS)) * 5
        q, residuals, errors = [q0], [], []
        for _ in range(STEPS):
            rho = self(q[-1]) - q0
            fit = rho * (1 + noise * self.rng.uniform(-1, 1, rho.shape))
            residuals.append(rho)
            errors.append(rho - fit)
            q.append(q0 + fit)
        return q, residuals, errors


def norms(mdp):
    return {"sup": sup, "mu": mean_square(mdp.mu), "uniform": mean_square()}


@pytest.mark.parametrize("which", ["sup", "mu", "uniform"])
@pytest.mark.parametrize("noise", [0.0, 0.02, 0.3])
@pytest.mark.parametrize("seed", range(5))
def test_no_bound_is_below_the_truth(seed, noise, which):
    mdp = Mdp(seed)
    norm, best = norms(mdp)[which], mdp.optimum()
    q, residuals, errors = mdp.learned(noise)
    truth = [norm(x - best) for x in q]
    lam = max(ratio(norm(e), norm(r)) for e, r in zip(errors, residuals, strict=True))
    pairs = [(x, best) for x in q]
    analytic = [q[0]]
    for _ in range(STEPS):
        analytic.append(mdp(analytic[-1]))
    pairs += zip(analytic, q, strict=True)
    lip = lipschitz(mdp, pairs, norm).max()
    assert lip <= lipschitz_limit(mdp.transitions, mdp.mu, mdp.gamma) or which != "mu"
    for k in range(1, STEPS + 1):
        assert truth[k] <= theorem_2(lam, lip, truth[0], k) * (1 + EXACT)
        every = np.array([norm(e) for e in errors[:k]])
        assert truth[k] <= accumulated(every, lip, truth[0]) * (1 + EXACT)
        own = every[:-1]
        gap = norm(analytic[k] - q[0] - residuals[k - 1])
        assert gap <= propagation(own, lip) + EXACT
        largest = np.array([sup(e) for e in errors[: k - 1]])
        first, size = sup(residuals[0]), sup(residuals[k - 1])
        assert size <= lemma_3(largest, first, mdp.gamma) + EXACT
        assert size <= lemma_2(largest, first, mdp.gamma, first) + EXACT
    if (limit := corollary_1(lam, lip)) < np.inf:
        assert theorem_2(lam, lip, 1.0, 200_000) == pytest.approx(limit, abs=EXACT)


def test_the_second_lemma_as_it_is_printed_can_be_too_small():
    """Without rewards and with a constant Q^0, max |r| is 0, but ϱ^1 is not."""
    mdp = Mdp(0)
    mdp.reward *= 0.0
    q0 = np.full((STATES, ACTIONS), 5.0)
    rho = mdp(q0) - q0
    assert lemma_2(np.empty(0), sup(rho), mdp.gamma, 0.0) < sup(rho)
    assert lemma_2(np.empty(0), sup(rho), mdp.gamma, sup(rho)) == sup(rho)


@pytest.mark.parametrize("gamma", [0.5, 0.99])
def test_estimates_agree_with_closed_forms(gamma):
    mdp = Mdp(1, gamma)
    q = mdp.rng.normal(size=(STATES, ACTIONS))
    found = lipschitz(mdp, [(q, q + 3.0), (q, q - 7.0)], sup)
    assert found == pytest.approx([gamma, gamma], abs=EXACT)
    # One action, a permutation of the states, uniform µ: T is γ times an isometry.
    mdp.transitions = np.eye(STATES)[mdp.rng.permutation(STATES)][:, None]
    mdp.reward, mu = mdp.reward[:, :1], np.full((STATES, 1), 1 / STATES)
    pairs = [(mdp.rng.normal(size=(STATES, 1)), q[:, :1]) for _ in range(5)]
    assert lipschitz(mdp, pairs, mean_square(mu)) == pytest.approx(gamma, abs=EXACT)
    assert lipschitz_limit(mdp.transitions, mu, gamma) == pytest.approx(gamma)
    # S y = mean of y: λ is the share of the standard deviation in the L2 norm.
    y = mdp.rng.normal(2.0, 1.0, size=(STATES, ACTIONS))
    norm = mean_square()
    assert ratio(norm(y - y.mean()), norm(y)) == pytest.approx(
        y.std() / np.sqrt(y.std() ** 2 + y.mean() ** 2), abs=EXACT
    )


def test_the_estimation_error_grows_with_the_fourth_power_of_the_range():
    assert estimation(0.3, 1000, 2.0) == estimation(1.0, 1000, 2.0)
    logs = np.log(42 * np.e) + 2 * np.log(480 * np.e * 100) + 2 * np.log(1000)
    assert estimation(10.0, 1000, 2.0) == pytest.approx(5136 * 1e4 * logs * 2 / 1000)


def test_all_states_lead_to_one_state_is_no_contraction():
    """A state that µ hardly visits and all others lead to: L2(µ) norms may grow."""
    p = np.zeros((2, 1, 2))
    p[:, 0, 1] = 1.0
    mu = np.array([[0.99], [0.01]])
    f, g = np.zeros((2, 1)), np.array([[0.0], [1.0]])
    found = lipschitz(lambda q: 0.9 * p @ q.max(-1), [(f, g)], mean_square(mu))
    assert found[0] == pytest.approx(9.0)
    assert lipschitz_limit(p, mu, 0.9) == pytest.approx(9.0)
