"""Extremely randomised trees, compiled; `forest` has the entry points."""

from bcrl.q.forest.forest import (
    Forest,
    ForestFit,
    Regression,
    TreeSettings,
    fit_forests,
    predict_forests,
)

__all__ = ["Forest", "ForestFit", "Regression", "TreeSettings"]
__all__ += ["fit_forests", "predict_forests"]
