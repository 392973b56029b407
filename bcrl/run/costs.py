"""The cost model of docs/explanation/cost.md, by environment and variant."""

import heapq
import os
from collections.abc import Iterable

from bcrl.config.plan import Plan
from bcrl.envs import is_simulated

#: Seconds of one core that a seed takes with the paper's budget, on a 2 GHz Xeon whose
#: other core does the same.
_SECONDS = {
    "car_on_hill": {"FQI": 24.5, "C-FQI": 19.9, "B-FQI": 32.8, "BC-FQI": 22.3},
    "maze": {"FQI": 1.6, "C-FQI": 2.9, "B-FQI": 1.6, "BC-FQI": 3.3},
    "mountain_car": {"FQI": 30.7, "C-FQI": 38.8, "B-FQI": 36.7, "BC-FQI": 58.3},
    "linear_system": {
        **{"DQN": 5.3, "C-DQN": 6.3, "BC-DQN": 4.7, "SC-DQN": 4.8, "SBC-DQN": 4.4},
        **{"RPL": 5.6, "PPR": 5.4},
    },
}
#: The iterations or steps of all stages in that budget.
_LENGTH = {"car_on_hill": 60, "maze": 280, "mountain_car": 125, "linear_system": 40_000}
#: Seconds per iteration or step of all other runs, by family.
_OTHERWISE = {"FQI": 0.1, "DQN": 1e-4}
#: The seconds that a Gymnasium environment adds, by its own Python and by evaluations.
_SIMULATED = {"FQI": 0.2, "DQN": 4e-4}


def expected(plan: Plan) -> float:
    """Seconds of one core that a seed of `plan` is expected to take."""
    if known := _SECONDS.get(plan.env, {}).get(plan.variant):
        return known * plan.length / _LENGTH[plan.env]
    rate = _OTHERWISE[plan.family]
    rate += _SIMULATED[plan.family] if is_simulated(plan.target) else 0.0
    return rate * plan.length


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
    return (
        f"the data of a batch take up to {needed / 2**30:.1f} GiB of memory, of "
        f"{there / 2**30:.1f} GiB; seeds.lockstep=1, fewer episodes, a smaller replay "
        "or observations take less"
    )
