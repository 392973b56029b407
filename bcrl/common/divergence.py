"""Whether learned values diverge, for a run's closing lines and for its report."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

_LIMIT = 10.0  # times the reference: a larger value counts as diverging


def diverging(metrics: Mapping[str, NDArray[np.float64]]) -> dict[str, float]:
    """The metrics (arrays (…, rows)) that diverge, and their largest magnitudes.

    The reference of an error is the error at the run's beginning, that of `q_mean` the
    largest measured discounted return.
    """
    found = {}
    for name, values in metrics.items():
        if name.startswith("q_error"):
            reference = _largest(values[..., :1])
        elif name == "q_mean" and "discounted_return" in metrics:
            reference = 1.0 + _largest(metrics["discounted_return"])
        else:
            continue
        if (most := _largest(values)) > _LIMIT * reference > 0.0:
            found[name] = most
    return found


def _largest(values: NDArray[np.float64]) -> float:
    """The largest finite magnitude; 0 if there is none."""
    sizes = np.abs(np.asarray(values, dtype=float))
    return float(np.max(sizes, initial=0.0, where=np.isfinite(sizes)))
