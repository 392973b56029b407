"""What a run costs: the model of docs/scaling.md, by environment and variant."""

from __future__ import annotations

from bcrl.compose import Plan

#: Seconds of one core (a 2 GHz Xeon) that a seed takes with the paper's budget.
SECONDS = {
    "car_on_hill": {"FQI": 26.0, "C-FQI": 26.0, "B-FQI": 33.0, "BC-FQI": 31.0},
    "maze": {"FQI": 3.5, "C-FQI": 3.5, "B-FQI": 3.5, "BC-FQI": 3.5},
    "linear_system": {
        "DQN": 4.0,
        "C-DQN": 4.0,
        "BC-DQN": 3.5,
        "SC-DQN": 3.5,
        "SBC-DQN": 3.5,
        "RPL": 4.0,
        "PPR": 4.0,
    },
}
#: Iterations or steps, over all stages, that these are for.
LENGTH = {"car_on_hill": 60, "maze": 280, "linear_system": 40_000}
#: Seconds an iteration or step of anything else, by family.
OTHERWISE = {"FQI": 0.1, "DQN": 1e-4}


def expected(plan: Plan) -> float:
    """Seconds of one core that a seed of `plan` is expected to take."""
    known = SECONDS.get(plan.env, {})
    rate = OTHERWISE[plan.family]
    if plan.variant in known:
        rate = known[plan.variant] / LENGTH[plan.env]
    return rate * plan.length
