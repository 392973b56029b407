"""What a command's runs have achieved: the lines after the last progress."""

import math
import shlex
from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from bcrl.common.text import ABSENT, aligned, duration, estimate, number
from bcrl.config import tags
from bcrl.config.plan import Plan
from bcrl.results.outcomes import Outcome, outcome
from bcrl.results.read import Finding
from bcrl.run import records

_LISTED = 20  # variants, and lines about tags
_COMPARED = 8  # variants that one figure can compare


def summary(plans: Sequence[Plan], seconds: float) -> str:
    """A table of the plans' returns, success rates, costs and folders, then what their
    tags stand for, how long the command took, and the next command."""
    rows = {str(plan.directory): _row(plan) for plan in plans[:_LISTED]}
    meanings = tags.meanings({plan.directory: plan.settings for plan in plans})
    returns = "return" + " [95 % interval]" * any(
        "[" in row[1] for row in rows.values()
    )
    lines = [aligned(rows, "seeds", returns, "success", "CPU")]
    lines += [f"… and {len(plans) - _LISTED} more folders"] * (len(plans) > _LISTED)
    lines += meanings[:_LISTED]
    lines += [f"… and {len(meanings) - _LISTED} more tags"] * (len(meanings) > _LISTED)
    lines += [line for plan in plans for line in diverging_lines(plan)]
    places: dict[tuple[str, str], list[Plan]] = {}  # those of one report
    for plan in plans:
        scale = plan.config["scale"]["name"]
        places.setdefault((scale, str(plan.root)), []).append(plan)
    lines.append(f"took {duration(seconds)}")
    return "\n".join([*lines, *map(_next, places.values())])


def diverging_lines(plan: Plan) -> list[str]:
    """Which metrics of which seeds diverge."""
    facts = {seed: records.read_facts(plan.directory, seed) for seed in plan.seeds}
    far = {s: ", ".join(each.get("diverging", ())) for s, each in facts.items()}
    lines = {s: f"{metrics} diverges" for s, metrics in far.items() if metrics}
    return records.by_reason(f"{plan.env} {plan.name}", lines)


def _row(plan: Plan) -> list[str]:
    """What the complete seeds of a plan ended with."""
    found = list[Outcome]()
    for seed in plan.seeds:
        with suppress(Finding):  # a seed's files that are damaged or missing
            found += filter(None, [outcome(plan.directory, seed)])
    success = np.mean([x.success for x in found]) if found else math.nan
    share = ABSENT if math.isnan(success) else f"{success:.0%}"
    cpu = duration(sum(x.cpu_seconds for x in found))
    seeds = f"{len(found)} of {len(plan.seeds)}"
    return [seeds, _returns([x.returned for x in found]), share, cpu]


def _returns(values: Sequence[float]) -> str:
    """Each seed's return or, of enough seeds, the mean and its interval."""
    from bcrl.results import statistics  # SciPy is slow to import

    if len(values) < statistics.FEWEST_SEEDS:
        return ", ".join(map(number, values)) or ABSENT
    return estimate(float(np.mean(values)), statistics.bootstrap(values))


def _next(plans: Sequence[Plan]) -> str:
    """The command that draws these runs, of one scale and folder."""
    words = ["bcrl-report", "--scale", plans[0].config["scale"]["name"]]
    if str(plans[0].root) != "runs":
        words.append(f"runs_dir={plans[0].root}")
    tagged = {plan.tag for plan in plans}
    alike = len({(plan.env, plan.family) for plan in plans}) == 1
    if len(tagged) == 1:
        words += ["--tag", *tagged] if None not in tagged else []
    elif alike and len(plans) <= _COMPARED:
        words += ["--env", plans[0].env, "--compare", *(plan.name for plan in plans)]
    if any(records.pending(plan, plan.asked) for plan in plans):
        words.append("--allow-incomplete")
    return f"next: {shlex.join(words)}"
