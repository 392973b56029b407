"""An own environment: swing a pendulum up, with ever less torque.

An environment is a frozen dataclass of its constants with pure functions on arrays,
so that all episodes of all seeds are stepped at once; docs/howto/own.md says more.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pandas as pd

from bcrl.api import FQI, Boost, Forest, run, stages


@dataclass(frozen=True)
class SwingUp:
    """State (angle from upright in rad, rate in rad/s); actions: torque −, 0, +."""

    torque: float = 3.0  # rad/s²; gravity pulls with up to 9.81
    gamma: float = 0.97
    horizon: int = 60

    name: ClassVar[str] = "swing_up"
    n_actions: ClassVar[int] = 3
    state_dim: ClassVar[int] = 2
    initial_noise: ClassVar[int] = 1  # uniforms in [0, 1) that `initial` takes
    step_noise: ClassVar[int] = 0

    def initial(self, noise):
        hanging = np.pi + 0.2 * (noise[..., 0] - 0.5)
        return np.stack([hanging, np.zeros_like(hanging)], -1)

    def step(self, state, action, noise=None):
        angle, rate = state[..., 0], state[..., 1]
        push = self.torque * (action - 1.0)
        rate = np.clip(rate + 0.1 * (9.81 * np.sin(angle) + push), -8.0, 8.0)
        angle = np.mod(angle + 0.1 * rate + np.pi, 2 * np.pi) - np.pi
        up = abs(angle) < 0.2
        return np.stack([angle, rate], -1), up.astype(float), up

    def evaluation_states(self):
        return self.initial((np.arange(10.0)[:, None] + 0.5) / 10)


tasks = [SwingUp(torque=torque) for torque in (8.0, 6.0, 4.0, 3.0)]
settings = {"iterations": 15, "evaluate_every": 15, "episodes": 100, "epsilon": 0.3}
learner = FQI(**settings, regressor=Forest(trees=20))
methods = [
    stages(tasks[-1:] * 4, learner),  # FQI
    stages(tasks, learner),  # C-FQI
    stages(tasks, learner, Boost()),  # BC-FQI
]
results = pd.concat(run(each, seeds=range(3), progress=False) for each in methods)

last = results[results.iteration == results.iteration.max()]
print(last.groupby("method")[["return", "solved"]].mean().round(2))
