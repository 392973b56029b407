"""Whether learned values run away, which runs and their report both want to know."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

FAR = 10.0  # times its yardstick: above this a value counts as diverging


def diverging(metrics: Mapping[str, NDArray[np.float64]]) -> dict[str, float]:
    """The metrics of values that diverge, and how large the largest is.

    Of arrays (…, rows). An error's yardstick is the error that the run begins with,
    `q_mean`'s the largest discounted return that was measured.
    """
    found = {}
    for name, values in metrics.items():
        if name.startswith("q_error"):
            yardstick = _largest(values[..., :1])
        elif name == "q_mean" and "discounted_return" in metrics:
            yardstick = 1.0 + _largest(metrics["discounted_return"])
        else:
            continue
        if (most := _largest(values)) > FAR * yardstick > 0.0:
            found[name] = most
    return found


def _largest(values: NDArray[np.float64]) -> float:
    """The largest finite magnitude; 0 if there is none."""
    sizes = np.abs(np.asarray(values, dtype=float))
    return float(np.max(sizes, initial=0.0, where=np.isfinite(sizes)))
