"""What a step of classic control costs, one core: python bench/classic.py

Microseconds of CPU per lane and step: Gymnasium's simulators and compiled lanes.
"""

from __future__ import annotations

import numpy as np
from timing import by_turns

from bcrl.envs.base import Lanes
from bcrl.envs.gymnasium import Gymnasium
from bcrl.envs.simulators import SimulatedLanes

STEPS = 100
BINS = [{"name": "DiscretizeAction", "bins": 5}]
TASKS = {"CartPole-v1": {}, "MountainCar-v0": {}, "Acrobot-v1": {}}
TASKS["Pendulum-v1"] = {"wrappers": BINS, "success": "survived"}


def main() -> None:
    print(f"{'us per lane and step':24}{'simulators':>12}{'compiled':>10}{'ratio':>8}")
    for name, changes in TASKS.items():
        task, rng = Gymnasium(name, **changes), np.random.default_rng(0)
        for n in (20, 100):
            start, actions = rng.random((n, 1)), rng.integers(2, size=(STEPS, n))
            pair: list[Lanes] = [SimulatedLanes(task), task.lanes()]
            states = [lanes.begin(start) for lanes in pair]

            def steps(lanes: Lanes, state: np.ndarray, actions: np.ndarray) -> None:
                for action in actions:
                    lanes.step(state, action, None)

            calls = [
                lambda own=own, state=state, actions=actions: steps(own, state, actions)
                for own, state in zip(pair, states, strict=True)
            ]
            slow, fast = (1e6 * t / STEPS / n for t in by_turns(calls, 5))
            label = f"{name}, {n} lanes"
            print(f"{label:24}{slow:12.1f}{fast:10.2f}{slow / fast:7.0f}x", flush=True)


if __name__ == "__main__":
    main()
