"""The regressors of fitted Q-iteration."""

from bcrl.q.regressors.base import Fit, FittedQ, Problem, Regressor
from bcrl.q.regressors.ours import REGRESSORS, ForestRegressor, Tabular
from bcrl.q.regressors.scikit import Sklearn, SklearnForest

__all__ = ["REGRESSORS", "Fit", "FittedQ", "ForestRegressor", "Problem"]
__all__ += ["Regressor", "Sklearn", "SklearnForest", "Tabular"]
