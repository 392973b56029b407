"""DQN in seed-lockstep against one seed in plain torch: python bench/dqn.py

Both learn the linear system's target task with the paper's settings on one core, and
take turns. A step is acting, replay and update; evaluation is timed separately. The
plain version is a `torch.nn` network with autograd, `torch.optim.Adam`, a NumPy replay
and the same environment with one lane. Times are microseconds of CPU per seed and
environment step, with one update per step.
"""

from __future__ import annotations

import copy
import itertools
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from bcrl.envs.base import Env
from bcrl.envs.linear_system import LinearSystem
from bcrl.evaluation.step_metrics import evaluate
from bcrl.learning.dqn import DQN
from bcrl.learning.stage import SeedBatch, Snapshot, Stage
from bcrl.learning.transfer import StageInit

ENV, STEPS, FILL = LinearSystem(), 1000, 600


def perceptron(n_in: int, n_out: int) -> torch.nn.Sequential:
    """The paper's network in plain torch: two hidden layers of 128."""
    layers = []
    for before, after in itertools.pairwise((n_in, 128, 128, n_out)):
        layers += [torch.nn.Linear(before, after), torch.nn.ReLU()]
    return torch.nn.Sequential(*layers[:-1])


def plain() -> Iterator[None]:
    """One seed, a step at each `next`."""
    rng = np.random.default_rng(0)
    online = perceptron(4, 8)
    target = copy.deepcopy(online)
    adam = torch.optim.Adam(online.parameters(), 1e-4)
    replay = [np.zeros((10_000, n), np.float32) for n in (4, 4, 1, 1, 1)]
    state, held = ENV.initial(rng.random(4)), 0
    while True:
        if rng.random() < 0.1:
            action = int(rng.integers(8))
        else:
            with torch.no_grad():
                action = int(
                    online(torch.from_numpy(state.astype(np.float32))).argmax()
                )
        after, reward, absorbing = ENV.step(state, np.array(action), rng.random(8))
        for part, value in zip(
            replay, (state, after, reward, absorbing, action), strict=True
        ):
            part[held % 10_000] = value
        held += 1
        state = ENV.initial(rng.random(4)) if absorbing or held % 150 == 0 else after
        if held > 500:
            rows = rng.integers(min(held, 10_000), size=32)
            x, y, r, done, a = (torch.from_numpy(part[rows]) for part in replay)
            with torch.no_grad():
                goal = r + 0.99 * (1 - done) * target(y).amax(1, keepdim=True)
            value = online(x).gather(1, a.long())
            loss = torch.nn.functional.smooth_l1_loss(value, goal)
            adam.zero_grad()
            loss.backward()
            adam.step()
            if held % 200 == 0:
                target.load_state_dict(online.state_dict())
        yield


def lockstep(n_seeds: int, env: Env = ENV, steps: int = STEPS) -> Iterator[Any]:
    """Many seeds, `steps` steps and a snapshot at each `next`."""
    learner = DQN(steps=10**9, evaluate_every=steps)
    stage = Stage(1, 1, env, learner, (), 0)
    team = SeedBatch(tuple(range(n_seeds)), np.zeros((1, env.state_dim)))
    pauses = learner.learn(stage, StageInit(), team)
    return (pause for pause in pauses if isinstance(pause, Snapshot))


def main() -> None:
    torch.set_num_threads(1)
    with threadpool_limits(1):
        one = plain()
        for _ in range(FILL):
            next(one)
        groups = {n: lockstep(n) for n in (1, 5, 20, 100)}
        for running in groups.values():
            next(running), next(running)  # filled, compiled, updating
        best, evaluation = {}, {}
        for _ in range(3):
            began = time.process_time()
            for _ in range(STEPS):
                next(one)
            took = (time.process_time() - began) / STEPS
            best["plain"] = min(best.get("plain", took), took)
            for n, running in groups.items():
                began = time.process_time()
                now = next(running)
                took = (time.process_time() - began) / STEPS / n
                best[n] = min(best.get(n, took), took)
                began = time.process_time()
                evaluate(now, range(n))
                took = (time.process_time() - began) / STEPS / n
                evaluation[n] = min(evaluation.get(n, took), took)
    print(f"{'seeds':>8}{'us per seed and step':>20}{'ratio':>8}{'evaluation, us':>16}")
    print(f"{'1, plain':>8}{best['plain'] * 1e6:20.0f}{1.0:7.1f}x")
    for n in groups:
        ratio = best["plain"] / best[n]
        print(f"{n:8}{best[n] * 1e6:20.0f}{ratio:7.1f}x{evaluation[n] * 1e6:16.0f}")


if __name__ == "__main__":
    main()
