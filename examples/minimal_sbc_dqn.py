"""SBC-DQN in one file (Klink et al., Boosted Curriculum Reinforcement Learning, 2022).

LSPI finds a quadratic Q_1 in the linear-quadratic task T_1. The target task T_2 has
walls and a drift. DQN learns a residual ϱ on the frozen base Q_1 there: Q = Q_1 + ϱ
(Eq. 5). Q_1 shapes the rewards, too (Ng et al., 1999). With Q_1 = 0 this is plain DQN.
"""

import copy

import numpy as np
import torch
from torch import nn

GAMMA, HORIZON, EPSILON = 0.99, 150, 0.1  # discount; steps of an episode; exploration
LEARNING_STARTS, CAPACITY, BATCH, LEARNING_RATE = 500, 10_000, 32, 1e-4
START = np.array([-4.0, 0.0, 0.0, 0.0])  # a state is (x, ẋ, y, ẏ); the goal is (0, 0)
ANGLES = np.pi / 4 * np.array([0, 2, 4, 6, 1, 7, 3, 5])
FORCES = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)  # the eight actions


def move(state, force, friction, dt=0.05, gain=2.0):
    """States (n, 4) of a point mass after one Euler step under forces (n, 2)."""
    slope = np.stack([state[:, 1::2], gain * force - friction * state[:, 1::2]], axis=2)
    return state + dt * slope.reshape(-1, 4)


def start(u):
    """Start states (n, 4) of T_2 from uniform draws u (n, 4)."""
    return START + (2 * u - 1) * [0.001, 0.1, 0.4, 0.1]


def step(state, action, fresh):
    """Next state (n, 4), reward (n,), absorbing (n,) in T_2 (paper, C.3; no noise)."""
    state = move(state, FORCES[action], friction=1.0) - [0.05 * 0.5, 0, 0, 0]  # drift
    inside = np.clip(state[:, 0], -5, 1)
    state[:, 1] *= np.where(state[:, 0] == inside, 1, -1)  # two walls reflect
    state[:, 0] = 2 * inside - state[:, 0]
    state = np.where(abs(state[:, 2:3]) > 0.5, fresh, state)  # off the path: start anew
    arrived = np.hypot(state[:, 0], state[:, 2]) < 0.2
    return state, np.where(arrived, 0.0, -1.0), arrived


def lspi(rng, iterations=4, samples=2000):
    """Matrix m of Q_1(s, a) = zᵀ m z with z = (s, a) in T_1 (Lagoudakis, Parr 2003)."""
    z, gain = rng.uniform(-4, 4, (samples, 6)), np.zeros((2, 4))
    after = move(z[:, :4], z[:, 4:], friction=0.1)
    reward = -(after**2 @ [3, 1, 3, 1]) - 0.1 * (z[:, 4:] ** 2).sum(axis=1)
    phi = np.einsum("ni,nj->nij", z, z).reshape(-1, 36)
    for _ in range(iterations):
        z = np.hstack([after, after @ gain.T])  # (s', a') of the policy a = gain s
        next_phi = np.einsum("ni,nj->nij", z, z).reshape(-1, 36)
        weights = np.linalg.pinv(phi.T @ (phi - GAMMA * next_phi)) @ (phi.T @ reward)
        m = weights.reshape(6, 6)
        gain = -np.linalg.solve(m[4:, 4:], m[4:, :4])  # of the greedy policy
    return m


def terms(network, m, state):
    """The two terms of Q = Q_1 + ϱ at states (n, 4), each of shape (n, 8)."""
    z = np.hstack([np.repeat(state, 8, axis=0), np.tile(FORCES, (len(state), 1))])
    base = (z @ m * z).sum(axis=1).reshape(-1, 8)
    return base, network(torch.from_numpy(state).float()).detach().numpy()


def sbc_dqn(network, m, rng, steps, target_update):
    """Train ϱ = `network` in place; yields each step's loss (nan without an update)."""
    target_network, loss = copy.deepcopy(network), torch.tensor(np.nan)
    optimiser = torch.optim.Adam(network.parameters(), LEARNING_RATE, fused=True)
    replay = np.zeros((CAPACITY, 11))  # rows (s, a, r, s', absorbing)
    state, age = start(rng.random((1, 4))), 0
    for now in range(1, steps + 1):
        greedy = sum(terms(network, m, state)).argmax(axis=1)
        action = rng.integers(8, size=1) if rng.random() < EPSILON else greedy
        after, reward, absorbing = step(state, action, start(rng.random((1, 4))))
        replay[now % CAPACITY - 1] = *state[0], *action, *reward, *after[0], *absorbing
        state, age = after, age + 1
        if absorbing or age == HORIZON:
            state, age = start(rng.random((1, 4))), 0
        if now > LEARNING_STARTS:
            rows = rng.integers(min(now, CAPACITY), size=BATCH)
            s, a, r, s2, end = np.split(replay[rows], [4, 5, 6, 10], axis=1)
            a, discount = a.astype(int), GAMMA * (1 - end)
            (q, _), (q2, rho2) = terms(network, m, s), terms(target_network, m, s2)
            r += discount * q2.max(1)[:, None] - q.max(1)[:, None]  # shaping
            # Eq. 5: r + γ (1 − absorbing) max_a' Q(s', a') − Q_1(s, a)
            y = r + discount * (q2 + rho2).max(1)[:, None] - np.take_along_axis(q, a, 1)
            output = network(torch.from_numpy(s).float()).gather(1, torch.from_numpy(a))
            loss = nn.functional.smooth_l1_loss(output, torch.from_numpy(y).float())
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        if now % target_update == 0:
            target_network.load_state_dict(network.state_dict())
        yield loss.item()


def evaluate(network, m, rng, n=50):
    """Mean return of n greedy episodes: −150 if none arrives."""
    state, alive, total = start(rng.random((n, 4))), np.ones(n, bool), 0
    for _ in range(HORIZON):
        action = sum(terms(network, m, state)).argmax(axis=1)
        state, reward, arrived = step(state, action, start(rng.random((n, 4))))
        total, alive = total + reward @ alive / n, alive & ~arrived
    return total


if __name__ == "__main__":
    torch.set_num_threads(1)  # Both settings make networks this small faster.
    torch.set_flush_denormal(True)
    print("method    steps  return")
    for name, target_update in (("DQN", 200), ("SBC-DQN", 2000)):  # in the paper 4000
        torch.manual_seed(0)
        rng = np.random.default_rng(0)
        m = lspi(rng) if name == "SBC-DQN" else np.zeros((6, 6))
        hidden = nn.Linear(4, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU()
        network = nn.Sequential(*hidden, nn.Linear(128, 8))
        for now, _ in enumerate(sbc_dqn(network, m, rng, 6_000, target_update), 1):
            if now % 2000 == 0:
                score = evaluate(network, m, np.random.default_rng(1))
                print(f"{name:8} {now:6}  {score:6.1f}")
