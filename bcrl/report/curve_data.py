"""What the page draws its interactive curves from, as plain data for JSON."""

from __future__ import annotations

import colorsys
import itertools
from typing import Any

import numpy as np
from matplotlib.colors import to_hex, to_rgb
from numpy.typing import NDArray

from bcrl.common.divergence import diverging
from bcrl.report import style
from bcrl.report.curves import LINEAR, figure_methods
from bcrl.report.figures import optimum_of
from bcrl.report.learning import COUNTED, curve, label, metrics_of, shared_spans
from bcrl.report.seedfiles import INDEX
from bcrl.report.variants import Runs, Variant

SEEDS = 20  # whose own lines can be shown, the first of a variant's
FIRST_SHOWN = 8  # variants that are shown at first if none has the tag
#: Metrics that are shown at first, if the family has many.
SHOWN = {"DQN": ("return", "success_rate", "greedy_return")}
DASHES = ("7 3", "2 3", "9 3 2 3", "5 2")  # one's own algorithms, then other tags


def curve_data(runs: Runs, env: str, family: str, tag: str | None) -> dict[str, Any]:
    """All variants of an environment and family, those of the tag shown at first."""
    found = {v.name: v for v in runs.of(env, family)}
    main = _main(runs, env, family, tag) or dict(list(found.items())[:FIRST_SHOWN])
    ours = {variant.name: variant for variant in main.values()}
    others = [name for name in found if name not in ours]
    dashes = {name: DASHES[0] for name, v in ours.items() if style.dashed(v.method)}
    tags = list(dict.fromkeys(variant.tag for variant in ours.values()))
    dashes |= {  # beside the first tag, the others need another look
        name: DASHES[(tags.index(v.tag) - 1) % len(DASHES)]
        for name, v in ours.items()
        if v.tag != tags[0]
    }
    dashes |= dict(zip(others, itertools.cycle(DASHES[1:]), strict=False))
    metrics = metrics_of(found)
    return {
        "id": f"{env}-{family}",
        "counter": INDEX[family][-1],
        "axis": COUNTED[family],
        "spans": shared_spans(ours),
        # A family that counts steps records undiscounted returns.
        "optimum": optimum_of(found) if family == "FQI" else None,
        "courses": any(v.task[0] != v.task[-1] for v in found.values()),
        "target": family == "DQN",
        "metrics": metrics,
        "labels": {metric: label(family, metric) for metric in metrics},
        "shown": [m for m in metrics if m in SHOWN.get(family, metrics)] or metrics,
        "series": [
            {"on": name in ours, "dash": dashes.get(name, "")}
            | _series(variant, metrics)
            for name, variant in (ours | found).items()
        ],
    }


def _main(runs: Runs, env: str, family: str, tag: str | None) -> dict[str, Variant]:
    """The variants that the page is about."""
    if (env, family) == (LINEAR, "DQN"):
        return figure_methods(runs, tag)
    return runs.tagged(env, family, tag)


def _series(variant: Variant, metrics: list[str]) -> dict[str, Any]:
    """A variant's curves, which all have the same points."""
    light = style.colour(variant.method)
    series = {
        "name": variant.name,
        "light": light,
        "dark": _on_black(light),
        "metrics": {},
    }
    for metric in metrics:
        if metric not in variant.metrics:
            continue
        found = curve(variant, metric)
        first, median, third = np.quantile(found.values, [0.25, 0.5, 0.75], axis=0)
        series |= {"x": found.x.tolist(), "task": variant.task[found.rows].tolist()}
        series["metrics"][metric] = {
            "far": metric in diverging(variant.metrics),  # the axis leaves it out
            "mean": _numbers(found.mean, 7),
            "low": _numbers(found.low),
            "high": _numbers(found.high),
            "median": _numbers(median),
            "q1": _numbers(first),
            "q3": _numbers(third),
            "seeds": [_numbers(values) for values in found.values[:SEEDS]],
        }
    return series


def _numbers(values: NDArray[np.float64], digits: int = 4) -> list[float | None]:
    """Rounded to significant digits; None for what is not finite."""
    return [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in values]


def _on_black(colour: str) -> str:
    """The same hue, light enough for a dark page; black turns nearly white."""
    hue, lightness, saturation = colorsys.rgb_to_hls(*to_rgb(colour))
    lightness = max(lightness, 0.6) if lightness else 0.95
    return to_hex(colorsys.hls_to_rgb(hue, lightness, saturation))
