"""An own environment in compiled code: a swing in small time steps, ever less push.

`compiled_step` turns the step of one state, with its loops and branches, into a step of
arrays: all episodes of all seeds are stepped in one call. docs/howto/own.md says more.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bcrl.api import FQI, Boost, Forest, compiled_step, run, stages


@compiled_step
def swing(state, action, noise, push):
    """0.1 s in ten small steps; at 1.2 rad the swing is high enough."""
    angle, rate = state
    for _ in range(10):
        rate += 0.01 * (push * (action - 1.0) - 9.81 * math.sin(angle))
        angle += 0.01 * rate
        if abs(angle) >= 1.2:
            return (angle, rate), 1.0, True
    return (angle, rate), 0.0, False


@dataclass(frozen=True)
class Swing:
    """State (angle from hanging in rad, rate in rad/s); actions: push −, 0, +."""

    push: float = 1.0  # rad/s²
    gamma: float = 0.97
    horizon: int = 80

    name: ClassVar[str] = "swing"
    n_actions: ClassVar[int] = 3
    state_dim: ClassVar[int] = 2
    initial_noise: ClassVar[int] = 2  # uniforms in [0, 1) that `initial` takes
    step_noise: ClassVar[int] = 0

    def initial(self, noise):
        return 0.2 * (noise - 0.5)

    def step(self, state, action, noise=None):
        return swing(state, action, noise, self.push)

    def evaluation_states(self):
        return self.initial(np.full((1, 2), 0.5))


tasks = [Swing(push) for push in (4.0, 2.0, 1.0)]
learner = FQI(iterations=20, episodes=100, epsilon=0.3, regressor=Forest(trees=20))
results = run(stages(tasks, learner, Boost()), seeds=range(3), progress=False)
last = results[results.iteration % learner.iterations == 0]  # of each task
print(last.groupby("task")[["return", "solved"]].mean().round(2))
