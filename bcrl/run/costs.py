"""The cost model of docs/explanation/cost.md, by environment and variant."""

import heapq
import os
from collections.abc import Iterable
from pathlib import Path

import yaml

from bcrl.config.plan import Plan
from bcrl.envs import is_simulated

_PAPER = yaml.safe_load(Path(__file__).with_name("costs.yaml").read_text("utf-8"))
#: Seconds per iteration or step of other runs, without and with a simulator.
_OTHERWISE = {"FQI": (0.1, 0.3), "DQN": (1e-4, 5e-4)}


def expected(plan: Plan) -> float:
    """Seconds of one core that a seed of `plan` is expected to take."""
    known = _PAPER.get(plan.env, {})
    if plan.variant in known:
        return known[plan.variant] * plan.length / known["length"]
    return _OTHERWISE[plan.family][is_simulated(plan.target)] * plan.length


def makespan(seconds: Iterable[float], workers: int) -> float:
    """The time at which the last job ends if `workers` take the jobs in this order."""
    free = [0.0] * workers
    for job in seconds:
        heapq.heapreplace(free, free[0] + job)
    return max(free)


def memory_note(plan: Plan) -> str | None:
    """A warning if the data of seeds that train together may not fit into memory."""
    needed = 0
    for stage in plan.stages:
        env, learner = stage.env, stage.learner
        evaluated = 2 * getattr(learner, "evaluation_episodes", 0)
        episodes = max(getattr(learner, "episodes", 0), evaluated)
        states = 2 * 8 * episodes * (env.horizon + 1) * env.state_dim  # and a copy
        row = 4 * (2 * env.state_dim + env.n_actions + 3)
        needed = max(needed, states + row * getattr(learner, "replay_size", 0))
    needed *= min(plan.lockstep, len(plan.seeds))
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed <= there:
        return None
    sizes = f"{needed / 2**30:.1f} of {there / 2**30:.1f} GiB of memory"
    return f"the data may take {sizes}; seeds.lockstep=1 or fewer episodes take less"
