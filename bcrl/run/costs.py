"""The cost model of docs/explanation/cost.md, by environment and variant."""

import heapq
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
