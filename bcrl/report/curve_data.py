"""What the page draws its interactive curves from, as plain data for JSON."""

import colorsys
from typing import Any

import numpy as np
from matplotlib.colors import to_hex, to_rgb

from bcrl.report.figures import curves, style
from bcrl.report.variants import Runs, Variant
from bcrl.results.layout import INDEX
from bcrl.results.statistics import bootstrap_curves

_SEEDS = 20  # whose own lines can be shown, the first of a variant's
_FIRST_SHOWN = 8  # variants that are shown at first if none has the tag
#: Metrics that are shown at first, if the family has many.
_SHOWN = {"DQN": ("return", "success_rate", "greedy_return")}
_STROKE = 2  # width of a line in page.css, pixels: dashes are in widths


def curve_data(runs: Runs, env: str, family: str, tag: str | None) -> dict[str, Any]:
    """All variants of an environment and family, those of the tag shown at first."""
    found = {v.name: v for v in runs.of(env, family)}
    main = [*runs.compared(env, tag, family).values()]
    ours = {v.name: v for v in main or [*found.values()][:_FIRST_SHOWN]}
    lines = style.lines_of(ours | found)
    metrics = curves.metrics_of(found)
    return {
        "id": f"{env}-{family}",
        "counter": INDEX[family][-1],
        "axis": curves.COUNTED[family],
        "spans": curves.shared_spans(ours),
        # A family that counts steps records undiscounted returns.
        "optimum": curves.optimum_of(found) if family == "FQI" else None,
        "courses": any((v.task != v.target).any() for v in found.values()),
        "target": family == "DQN",
        "metrics": metrics,
        "labels": {metric: curves.label(family, metric) for metric in metrics},
        "shown": [m for m in metrics if m in _SHOWN.get(family, metrics)] or metrics,
        "series": [
            {"on": name in ours} | _series(variant, metrics, lines[name])
            for name, variant in (ours | found).items()
        ],
    }


def _series(variant: Variant, metrics: list[str], line: style.Line) -> dict[str, Any]:
    """A variant's look, as in the figures, and curves, which have the same points."""
    rows, light = curves.spread_rows(variant), line["color"]
    dashes = () if line["linestyle"] == "-" else line["linestyle"][1]
    drawn = {}
    for metric in (name for name in metrics if name in variant.metrics):
        values = variant.metrics[metric][:, rows]
        lines = *bootstrap_curves(values), *np.quantile(values, [0.25, 0.5, 0.75], 0)
        named = zip(("low", "high", "q1", "median", "q3"), lines, strict=True)
        drawn[metric] = {name: _numbers(line) for name, line in named} | {
            "mean": _numbers(values.mean(axis=0), 7),
            "seeds": [_numbers(seed) for seed in values[:_SEEDS]],
            "far": metric in variant.far,
        }
    # The same hue, light enough for a dark page; black turns nearly white.
    hue, lightness, saturation = colorsys.rgb_to_hls(*to_rgb(light))
    lightness = 0.42 + 0.55 * lightness if lightness else 0.95
    return {
        "name": variant.name,
        "light": light,
        "dark": to_hex(colorsys.hls_to_rgb(hue, lightness, saturation)),
        "dash": " ".join(f"{_STROKE * each:g}" for each in dashes),
        "x": variant.index[rows].tolist(),
        "task": variant.task[rows].tolist(),
        "target": variant.target,
        "metrics": drawn,
    }


def _numbers(values: np.ndarray, digits: int = 4) -> list[float | None]:
    """Rounded to significant digits; None for what is not finite."""
    return [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in values]
