"""What a step of each DQN method costs, one core: python bench/methods.py

The seven methods of Fig. 4 with the paper's settings, 100 seeds in teams of 20 as the
runner has them, one team after the other. The replay is filled first, for young buffers
draw the same transitions again and again; then 500 steps with their updates are timed,
and an evaluation, which a run makes every 1000 steps. Microseconds of CPU a seed and
step. The first line says how fast this core multiplies the update's matrices meanwhile.
"""

from __future__ import annotations

import sys
import time

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from bcrl.config import flags, jobs
from bcrl.config.plan import Plan
from bcrl.evaluation.step_metrics import evaluate
from bcrl.learning.dqn_trainer import DQNTrainer
from bcrl.learning.stage import SeedBatch, learn
from bcrl.learning.transfer import begin

METHODS = ("plain", "C", "BC", "SC", "SBC", "RPL", "PPR")
SEEDS, TEAM, STEPS = 100, 20, 500


def planned(variant: str) -> Plan:
    """The method's plan, its pretraining in LQ cut short."""
    choice = ["env=linear_system", "algorithm=dqn", f"variant={variant}"]
    choice += ["algorithm.steps=[600,30000]"] * (variant == "C")
    sys.argv = ["bcrl", *choice]
    (plan,) = jobs.plans(flags.arguments())
    return plan


def running(plan: Plan, seeds: tuple[int, ...]) -> DQNTrainer:
    """A team in its target task with a full replay."""
    batch, result = SeedBatch(seeds, np.zeros((1, 4))), None
    for now in learn(plan.stages[:-1], batch):
        result = now.result
    last = plan.stages[-1]
    run = DQNTrainer(last.learner, last, begin(last.transfers, result), batch)
    for _ in range(last.learner.replay_size):
        run.act()
        run.end_step()
    run.act()
    run.update()  # compiled
    run.end_step()
    return run


def cost(run: DQNTrainer) -> tuple[float, float]:
    """Seconds of CPU of a step with its update, and of an evaluation a step."""
    n = len(run.batch.seeds)
    began = time.process_time()
    for _ in range(STEPS):
        run.act()
        run.update()
        run.end_step()
    stepping = (time.process_time() - began) / STEPS / n
    began = time.process_time()
    evaluate(run.snapshot(), run.batch.seeds)
    every = run.settings.evaluate_every
    return stepping, (time.process_time() - began) / every / n


def multiplying() -> float:
    """GFLOP/s of products (32, 128) · (128, 128), the least time of many."""
    a, b = np.ones((32, 128), np.float32), np.ones((128, 128), np.float32)
    out, best = np.empty((32, 128), np.float32), np.inf
    for _ in range(50):
        began = time.perf_counter()
        for _ in range(100):
            np.dot(a, b, out)
        best = min(best, time.perf_counter() - began)
    return 100 * 2 * 32 * 128 * 128 / best / 1e9


def main() -> None:
    torch.set_num_threads(1)
    print(
        f"this core multiplies (32, 128) by (128, 128) at {multiplying():.0f} GFLOP/s"
    )
    print(f"{'us a seed and step':20}{'acting, updating':>18}{'evaluation':>12}")
    means = []
    for variant in METHODS:
        plan = planned(variant)
        teams = [tuple(range(s, s + TEAM)) for s in range(0, SEEDS, TEAM)]
        found = np.mean([cost(running(plan, seeds)) for seeds in teams], 0) * 1e6
        means.append(found)
        print(f"{plan.variant:20}{found[0]:18.1f}{found[1]:12.1f}", flush=True)
    stepping, evaluation = np.mean(means, 0)
    print(f"{'mean':20}{stepping:18.1f}{evaluation:12.1f}")
    print(
        f"with the exploring half of the evaluation {stepping + evaluation / 2:.1f}, "
        f"with all of it {stepping + evaluation:.1f}; "
        f"now {multiplying():.0f} GFLOP/s"
    )


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
