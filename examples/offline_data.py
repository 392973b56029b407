"""Offline learning: logs of a random policy, one per task, and FQI without own data.

Each log is what a loop over Gymnasium's `step` sees; `log.save("pole.npz")` keeps one
for `algorithm.dataset=pole.npz` (docs/howto/offline_data.md).
"""

import gymnasium
import numpy as np
import pandas as pd

from bcrl.api import FQI, Boost, Forest, Gymnasium, Transitions, run, stages


def logged(gravity: float, steps: int, seed: int) -> Transitions:
    """Transitions of a random policy in CartPole; its return is about 20."""
    env = gymnasium.make("CartPole-v1")
    env.unwrapped.gravity = gravity  # m/s²
    env.action_space.seed(seed)
    observation, _ = env.reset(seed=seed)
    rows = []
    for _ in range(steps):
        action = env.action_space.sample()
        after, reward, terminated, truncated, _ = env.step(action)
        # Not `truncated`: the value after a time limit is not zero.
        rows.append((observation, action, reward, after, terminated))
        observation = env.reset()[0] if terminated or truncated else after
    return Transitions(*map(np.array, zip(*rows, strict=True)))


gravities = (4.0, 9.8)  # the last is CartPole-v1's own
tasks = [
    Gymnasium("CartPole-v1", attributes={"gravity": g}, starts=20) for g in gravities
]
logs = [logged(g, steps=4000, seed=0) for g in gravities]
settings = {"iterations": 25, "evaluate_every": 25, "regressor": Forest(trees=30)}
learners = [FQI(dataset=log, **settings) for log in logs]
methods = [
    stages(tasks[-1:] * 2, learners[-1], Boost()),  # B-FQI
    stages(tasks, learners, Boost()),  # BC-FQI
]
results = pd.concat(run(each, seeds=range(2), progress=False) for each in methods)

last = results.groupby(["method", "seed"]).tail(1)
print(last.groupby("method")[["return", "solved"]].mean().round(3))
