"""The verdicts on the line search, as docs/explanation/line_search.md defines them.

python research/line_search.py runs docs/results/line_search.md
"""

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bcrl.common.files import write_text
from bcrl.common.text import estimate, number
from bcrl.report.load import load_runs
from bcrl.report.tables import TextTable
from bcrl.report.variants import LINEAR, Variant
from bcrl.results.statistics import bootstrap, share_interval

MARGIN = 5.0  # of a return: what counts as equivalent
BEST, EACH = -105.0, -115.0  # mean returns of L2
FREQUENCIES = (1000, 2000, 4000)
HEAD = """# Line search in the linear system

[How much of the past to keep](../explanation/line_search.md) explains the method and
the claims L1 to L3. F is the number of steps between two copies to the target network.
A seed never arrives if its success rate is 0 in the last 5000 steps. Means have 95 %
bootstrap intervals, shares score intervals; differences are paired by seed.

    bcrl experiment=line_search scale=paper
    bcrl env=linear_system algorithm=dqn scale=paper
    python research/line_search.py runs docs/results/line_search.md
"""


class Key(NamedTuple):
    """A method, the target-update frequency of its last stage, and its factor."""

    method: str
    frequency: int
    alpha: float | str


def frequency_of(variant: Variant) -> int:
    """F, the steps between two copies to the target network, in the target task."""
    every = variant.config["algorithm"]["target_update"]
    return int(every[-1] if isinstance(every, list) else every)


def key_of(variant: Variant) -> Key:
    """What tells the runs apart."""
    frequency = frequency_of(variant)
    return Key(variant.method, frequency, variant.config["boosting"].get("alpha", 1.0))


def row_of(key: Key, variant: Variant) -> dict[str, str]:
    """A row of the first table."""
    late, success = variant.late("return"), variant.late("success_rate")
    failing = int((success == 0.0).sum())
    row = {"method": key.method, "F": str(key.frequency)}
    row["base"] = "line search" if key.alpha == "search" else "Equation 5"
    row |= {
        "seeds": str(len(late)),
        "late return": estimate(late.mean(), bootstrap(late)),
    }
    share = failing / len(late), share_interval(failing, len(late))
    row |= {"seeds that never arrive": estimate(*share)}
    alpha = variant.metrics.get("alpha", np.ones((1, 1)))[:, -1]
    low, middle, high = np.quantile(alpha, [0.0, 0.5, 1.0])
    return row | {"α: median (least, most)": f"{middle:.3g} ({low:.2g}, {high:.2g})"}


def difference(one: Variant, other: Variant) -> tuple[float, tuple[float, float]]:
    """The mean difference of late returns and its interval, paired by seed."""
    if one.seeds != other.seeds:
        raise SystemExit(f"{one.name} and {other.name} have different seeds")
    change = one.late("return") - other.late("return")
    return float(change.mean()), bootstrap(change)


def no_worse(interval: tuple[float, float]) -> str:
    """The verdict of L3 for one pair."""
    low, high = interval
    if low > -MARGIN:
        return "better" if low > 0 else "no worse (equivalence)"
    return "no difference shown" if high >= 0 else "worse"


def verdicts(found: dict[Key, Variant]) -> Iterable[dict[str, str]]:
    """The rows of the second table."""
    plain = next(v for k, v in found.items() if k.method == "DQN")
    means = {}
    for f in FREQUENCIES:
        searched = found[Key("BC-DQN", f, "search")]
        means[f] = searched.late("return").mean()
        change, interval = difference(searched, plain)
        holds = "holds" if interval[0] > 0 else "does not hold"
        name = f"L1 BC-DQN, line search − DQN, F = {f}"
        yield {"claim": name, "measured": estimate(change, interval), "verdict": holds}
    text = ", ".join(number(mean) for mean in means.values())
    holds = max(means.values()) >= BEST and min(means.values()) >= EACH
    claim = f"L2 best mean ≥ {number(BEST)}, each ≥ {number(EACH)}"
    verdict = "holds" if holds else "does not hold"
    yield {"claim": claim, "measured": text, "verdict": verdict}
    for method in ("BC-DQN", "SBC-DQN"):
        for f in FREQUENCIES:
            pair = (found[Key(method, f, alpha)] for alpha in ("search", 1.0))
            change, interval = difference(*pair)
            claim = f"L3 {method}, line search − Equation 5, F = {f}"
            row = {"claim": claim, "measured": estimate(change, interval)}
            yield row | {"verdict": no_worse(interval)}


def main(runs_dir: str, target: str) -> None:
    """Write both tables."""
    runs = load_runs(Path(runs_dir), "paper", False)
    every = (v for v in runs.variants if v.env == LINEAR)
    wanted = (v for v in every if v.method in ("DQN", "BC-DQN", "SBC-DQN"))
    found = {key_of(v): v for v in wanted if v.tag not in ("released", "paper")}
    rows = [row_of(k, found[k]) for k in sorted(found, key=str)]
    parts = [HEAD, str(TextTable(rows))]
    revision = next(iter(found.values())).sidecars[0]["git"]["revision"]
    parts += [str(TextTable(list(verdicts(found)))), f"Revision {revision[:7]}."]
    write_text(Path(target), "\n".join([*parts, ""]))


if __name__ == "__main__":
    main(*sys.argv[1:])
