"""Measures per seed and verdicts: see docs/explanation/negative_transfer.md."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from bcrl.learning import Floats
from bcrl.results.statistics import Interval, bootstrap
from research.misleading_tasks import ONLY

MARGIN = 0.02  # share of plain's gain that a method may lose
KEPT = 0.95  # share of boosting's gain that a line search must keep
THRESHOLD = 0.8  # share of plain's gain that counts as solved
_SEED = 20_261_126  # of the resampled seeds


class Scale(NamedTuple):
    """Plain's mean return at its first evaluation and at the end."""

    first: float  # r0
    last: float  # r1

    @property
    def gain(self) -> float:
        """r1 − r0."""
        return self.last - self.first


@dataclass(frozen=True)
class Measures:
    """What each of S seeds reached in the target; arrays (S,)."""

    jumpstart: Floats  # the target's first return, before plain's is subtracted
    time: Floats  # share of the budget until the threshold; inf: not reached
    area: Floats  # mean return over the budget
    final: Floats  # mean return at the end


def scale_of(plain: pd.DataFrame, late: float) -> Scale | None:
    """r0 and r1; None unless the 95 % interval of plain's gain lies above 0."""
    steps, returns, _ = _curves(plain)
    first, last = returns[:, 0], _final(steps, returns, late)
    if not bootstrap(last - first)[0] > 0.0:
        return None
    return Scale(float(first.mean()), float(last.mean()))


def measure(frame: pd.DataFrame, scale: Scale, late: float, alone: bool) -> Measures:
    """The measures of a job; `alone`: whether all its stages have the target."""
    steps, returns, stage = _curves(frame)
    total = steps[-1]
    begun = 0 if alone else int(np.argmax(stage == stage[-1]))
    filled = returns.copy()
    filled[:, :begun] = scale.first  # while a source is learned
    widths = np.diff(steps, prepend=0.0)
    area = (filled * widths).sum(1) / total
    enough = returns[:, begun:] >= scale.first + THRESHOLD * scale.gain
    place = np.where(enough.any(1), enough.argmax(1), -1)
    time = np.where(place >= 0, steps[begun:][place] / total, np.inf)
    return Measures(returns[:, begun], time, area, _final(steps, returns, late))


def _curves(frame: pd.DataFrame) -> tuple[Floats, Floats, Floats]:
    """Steps (n,), returns (S, n) and stages (n,); seeds in order."""
    index = "iteration" if "iteration" in frame else "step"
    rows = [own for _, own in frame.groupby("seed")]
    first = rows[0]
    returns = np.stack([own["return"].to_numpy(float) for own in rows])
    return first[index].to_numpy(float), returns, first["stage"].to_numpy(float)


def _final(steps: Floats, returns: Floats, late: float) -> Floats:
    end = returns[:, steps > steps[-1] * (1.0 - late) + 1e-9]
    found: Floats = end.mean(1)
    return found


def scaled(values: Floats, plain: Floats, scale: Scale) -> tuple[float, Interval]:
    """Mean of values − plain, paired by seed, and its interval; shares of r1 − r0."""
    difference = (values - plain) / scale.gain
    return float(difference.mean()), bootstrap(difference)


def verdict(interval: Interval) -> str:
    """Whether a method ends worse than plain, by the interval of `scaled`."""
    low, high = interval
    if high < -MARGIN:
        return "worse"
    return "not worse" if low >= -MARGIN else "undecided"


class Kept(NamedTuple):
    """The share of boosting's gain over plain that a line search has."""

    share: float
    interval: Interval
    verdict: str  # keeps (point), keeps (interval), loses, or no gain


def kept_gain(boosted: Floats, searched: Floats, plain: Floats) -> Kept:
    """Compare two gains over plain, (S,) each, paired by seed."""
    gain, own = boosted - plain, searched - plain
    if not bootstrap(gain)[0] > 0.0:
        return Kept(np.nan, (np.nan, np.nan), "no gain")
    share = float(own.mean() / gain.mean())
    if np.array_equal(own, gain):
        return Kept(1.0, (1.0, 1.0), "keeps (point)")

    def ratio(a: Floats, b: Floats, axis: int) -> Floats:
        found: Floats = a.mean(axis) / b.mean(axis)
        return found

    resampled = stats.bootstrap(
        (own, gain),
        ratio,
        paired=True,
        method="percentile",
        rng=np.random.default_rng(_SEED),
    )
    low, high = map(float, resampled.confidence_interval)
    how = "keeps (interval)" if high >= KEPT else "loses"
    return Kept(share, (low, high), "keeps (point)" if share >= KEPT else how)


def summary(
    found: Mapping[tuple[str, str, str], Measures], scales: Mapping[str, Scale]
) -> pd.DataFrame:
    """One row per environment, curriculum and method, compared with plain."""
    rows = []
    for (env, curriculum, method), own in found.items():
        plain, scale = found[env, ONLY, "plain"], scales[env]
        row: dict[str, object] = {"env": env, "scenario": curriculum, "method": method}
        for name in ("final", "area", "jumpstart"):
            mean, (low, high) = scaled(getattr(own, name), getattr(plain, name), scale)
            row |= {name: mean, f"{name}_low": low, f"{name}_high": high}
        reached = np.isfinite(own.time)
        row["reached"] = reached.mean()
        row["time"] = float(np.median(own.time))
        interval = float(row["final_low"]), float(row["final_high"])  # type: ignore[arg-type]
        rows.append(row | {"verdict": "" if method == "plain" else verdict(interval)})
    return pd.DataFrame(rows)
