"""BC-FQI in one file: boosted curriculum fitted Q-iteration, car on the hill.

The algorithm of Klink et al., "Boosted Curriculum Reinforcement Learning" (ICLR 2022),
with NumPy and scikit-learn. An engine that is too weak must rock a car up a hill. The
curriculum is a sequence of tasks T_1 … T_n with ever heavier cars; T_n is the target.
Task t freezes the Q-function of task t − 1 and learns only a residual ϱ_t on top of it:

    Q_t = Q_{t-1} + ϱ_t = ϱ_1 + … + ϱ_t                                          (Eq. 5)

A light car sometimes reaches the goal by chance, a heavy car does not. The sum keeps
what the light car has taught. Run `python examples/minimal_bc_fqi.py` to see it.
"""

import numpy as np
from sklearn.ensemble import ExtraTreesRegressor

MASSES = (0.8, 1.0, 1.2)  # kg, one task each; 1.2 kg is the target task
GAMMA, HORIZON = 0.95, 100  # discount factor; steps of an episode
EPISODES, ITERATIONS, TREES = 200, 10, 20  # per task; in the paper 1000, 20 and 50
GRAVITY, FORCES = 9.81, np.array([-4.0, 4.0])  # m/s²; N, of action 0 and action 1


# --- Environment (paper, C.1) ---


def acceleration(p, v, mass, force):
    """dv/dt (n,) of cars at position p (n,) with velocity v (n,)."""
    q = 1 + 5 * p**2
    slope = np.where(p < 0, 2 * p + 1, q**-1.5)
    curvature = np.where(p < 0, 2, -15 * p * q**-2.5)
    return (force / mass - slope * (GRAVITY + v**2 * curvature)) / (1 + slope**2)


def step(mass, state, action, substeps=20):
    """Next state (n, 2), reward (n,), absorbing (n,) of state (n, 2), action (n,).

    The force acts for 0.1 s. Position p > 1 is the goal and pays 1; a car with p < −1
    or a speed above 3 is lost and pays −1. Both end the episode.
    """
    (p, v), force, dt = state.T, FORCES[action], 0.1 / substeps
    for _ in range(substeps):  # midpoint rule
        p_half, v_half = p + dt / 2 * v, v + dt / 2 * acceleration(p, v, mass, force)
        p, v = p + dt * v_half, v + dt * acceleration(p_half, v_half, mass, force)
    lost = (p < -1) | (abs(v) > 3)
    reward = np.where(lost, -1.0, np.where(p > 1, 1.0, 0.0))
    return np.stack([p, v], axis=1), reward, reward != 0


def random_episodes(mass, episodes, rng):
    """Transitions (s, a, r, s', absorbing) of a uniformly random policy."""
    state, transitions = np.tile([-0.5, 0.0], (episodes, 1)), []
    for _ in range(HORIZON):
        action = rng.integers(2, size=len(state))
        after, reward, absorbing = step(mass, state, action)
        transitions.append((state, action, reward, after, absorbing))
        state = after[~absorbing]
    return [np.concatenate(column) for column in zip(*transitions, strict=True)]


# --- Algorithm (paper, Eq. 5) ---


def q_values(residuals, states):
    """Q(s, ·) = Σ_i ϱ_i(s, ·) at states (n, 2): shape (n, 2). An empty sum is 0."""
    q = np.zeros((len(states), 2))
    for forests in residuals:
        q += np.stack([forest.predict(states) for forest in forests], axis=1)
    return q


def bc_fqi(datasets, iterations, rng, trees=TREES):
    """One residual per dataset, each a pair of forests: one forest per action.

    With a single dataset this is plain FQI (Ernst et al., 2005): nothing is frozen.
    """
    residuals = []  # ϱ_1 … ϱ_{t-1}, frozen
    for state, action, reward, next_state, absorbing in datasets:
        base = q_values(residuals, state)[range(len(state)), action]  # Q_{t-1}(s, a)
        next_base = q_values(residuals, next_state)  # Q_{t-1}(s', ·)
        next_residual = np.zeros_like(next_base)  # ϱ_t(s', ·) is 0 before the first fit
        for _ in range(iterations):
            best = (next_base + next_residual).max(axis=1)  # max_a' Q_t(s', a')
            target = reward + GAMMA * (1 - absorbing) * best - base
            forests = []
            for a in range(2):
                seed = rng.integers(2**31)
                forest = ExtraTreesRegressor(
                    trees, min_samples_split=5, min_samples_leaf=2, random_state=seed
                )
                forests.append(forest.fit(state[action == a], target[action == a]))
            next_residual = q_values([forests], next_state)
        residuals.append(forests)
    return residuals


def evaluate(residuals, mass, rng):
    """Mean discounted return and share at the goal, greedy policy, 100 start states."""
    state = np.stack(np.meshgrid(np.linspace(-1, 1, 10), np.linspace(-3, 3, 10)), -1)
    state, total, goals = state.reshape(-1, 2), 0.0, 0
    for t in range(HORIZON):
        q = q_values(residuals, state)
        action = (q + 1e-9 * rng.random(q.shape)).argmax(axis=1)  # random among equals
        state, reward, absorbing = step(mass, state, action)
        total, goals = total + GAMMA**t * reward.sum(), goals + (reward > 0).sum()
        state = state[~absorbing]
        if len(state) == 0:
            break
    return total / 100, goals / 100


if __name__ == "__main__":
    rng = np.random.default_rng(0)
    datasets = [random_episodes(mass, EPISODES, rng) for mass in MASSES]
    fqi = bc_fqi(datasets[-1:], ITERATIONS * len(MASSES), rng)  # same number of fits
    boosted = bc_fqi(datasets, ITERATIONS, rng)
    stages = [("BC-FQI", mass, boosted[: t + 1]) for t, mass in enumerate(MASSES)]
    print("method  mass  return  at the goal")
    for name, mass, residuals in [("FQI", MASSES[-1], fqi), *stages]:
        score, goal = evaluate(residuals, mass, rng)
        print(f"{name:6}  {mass:4}  {score:6.3f}  {goal:11.0%}")
