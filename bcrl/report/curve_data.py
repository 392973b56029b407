"""What the page draws its interactive curves from, as plain data for JSON."""

from __future__ import annotations

import colorsys
import itertools
from typing import Any

import numpy as np
from matplotlib.colors import to_hex, to_rgb
from numpy.typing import NDArray

from bcrl.common.divergence import diverging
from bcrl.report.figures import style
from bcrl.report.figures.curves import (
    COUNTED,
    label,
    metrics_of,
    optimum_of,
    shared_spans,
    spread_rows,
)
from bcrl.report.statistics import bootstrap_curves
from bcrl.report.variants import Runs, Variant
from bcrl.results.layout import INDEX

_SEEDS = 20  # whose own lines can be shown, the first of a variant's
_FIRST_SHOWN = 8  # variants that are shown at first if none has the tag
#: Metrics that are shown at first, if the family has many.
_SHOWN = {"DQN": ("return", "success_rate", "greedy_return")}
_DASHES = ("7 3", "2 3", "9 3 2 3", "5 2")  # one's own algorithms, then other tags


def curve_data(runs: Runs, env: str, family: str, tag: str | None) -> dict[str, Any]:
    """All variants of an environment and family, those of the tag shown at first."""
    found = {v.name: v for v in runs.of(env, family)}
    main = (
        runs.compared(env, tag, family).values() or list(found.values())[:_FIRST_SHOWN]
    )
    ours = {variant.name: variant for variant in main}
    first, *_ = tags = list(dict.fromkeys(variant.tag for variant in main))
    dashes = {name: _DASHES[0] for name, v in ours.items() if style.dashed(v.method)}
    dashes |= {  # beside the first tag, the others need another look
        name: _DASHES[(tags.index(v.tag) - 1) % len(_DASHES)]
        for name, v in ours.items()
        if v.tag != first
    }
    others = [name for name in found if name not in ours]
    dashes |= dict(zip(others, itertools.cycle(_DASHES[1:]), strict=False))
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
        "shown": [m for m in metrics if m in _SHOWN.get(family, metrics)] or metrics,
        "series": [
            {"on": name in ours, "dash": dashes.get(name, "")}
            | _series(variant, [m for m in metrics if m in variant.metrics])
            for name, variant in (ours | found).items()
        ],
    }


def _series(variant: Variant, metrics: list[str]) -> dict[str, Any]:
    """A variant's curves, which all have the same points; those `far` off are cut."""
    rows, light = spread_rows(variant), style.colour(variant.method)
    far, curves = diverging(variant.metrics), {}
    for metric in metrics:
        values = variant.metrics[metric][:, rows]
        low, high = bootstrap_curves(values)
        q1, median, q3 = np.quantile(values, [0.25, 0.5, 0.75], axis=0)
        lines = {"low": low, "high": high, "median": median, "q1": q1, "q3": q3}
        curves[metric] = {name: _numbers(line) for name, line in lines.items()}
        curves[metric]["mean"] = _numbers(values.mean(axis=0), 7)
        curves[metric]["seeds"] = [_numbers(seed) for seed in values[:_SEEDS]]
        curves[metric]["far"] = metric in far
    return {
        "name": variant.name,
        "light": light,
        "dark": _on_black(light),
        "x": variant.index[rows].tolist(),
        "task": variant.task[rows].tolist(),
        "metrics": curves,
    }


def _numbers(values: NDArray[np.float64], digits: int = 4) -> list[float | None]:
    """Rounded to significant digits; None for what is not finite."""
    return [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in values]


def _on_black(colour: str) -> str:
    """The same hue, light enough for a dark page; black turns nearly white."""
    hue, lightness, saturation = colorsys.rgb_to_hls(*to_rgb(colour))
    lightness = max(lightness, 0.6) if lightness else 0.95
    return to_hex(colorsys.hls_to_rgb(hue, lightness, saturation))
