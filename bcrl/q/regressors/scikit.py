"""scikit-learn's regressors in fitted Q-iteration."""

import functools
import importlib
import inspect
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from bcrl.common.checks import one_of
from bcrl.errors import ConfigError, at_least, did_you_mean
from bcrl.q.regressors.base import Fit, Problem

#: Modules of scikit-learn whose regressors take plain values as arguments.
MODULES = (
    *("dummy", "ensemble", "gaussian_process", "isotonic", "kernel_ridge"),
    *("linear_model", "neighbors", "neural_network", "svm", "tree"),
)


class _Fitting(ABC):
    """Fits a `_model(seed)` to each problem; multiplicities become repeated rows."""

    finite_only = False

    @abstractmethod
    def _model(self, seed: int) -> Any: ...

    def fit(self, problems: Sequence[Problem], keep: bool, threads: int) -> list[Fit]:
        models = [self._model(int(p.rng.integers(2**31))) for p in problems]
        with threadpool_limits(1):  # sums would depend on the number of threads
            for model, p in zip(models, problems, strict=True):
                repeat = np.repeat(np.arange(len(p.y)), p.multiplicity)
                model.fit(p.x[repeat], p.y[repeat])
        points = [np.concatenate([p.x, p.queries]) for p in problems]
        found = zip(models, problems, self.predict(models, points, 1), strict=True)
        return [Fit(model, *np.split(both, [len(p.y)])) for model, p, both in found]

    def predict(
        self, models: Sequence[Any], x: Sequence[NDArray], threads: int
    ) -> list[NDArray[np.float64]]:
        with threadpool_limits(1):
            found = [m.predict(points) for m, points in zip(models, x, strict=True)]
        return [np.asarray(values, np.float64) for values in found]


@dataclass(frozen=True)
class Sklearn(_Fitting):
    """Any regressor of scikit-learn, by the name of its class and its arguments.

    From Python, `estimator` may also be an estimator or a pipeline. `standardise` puts
    a StandardScaler before it. Each fit has its own `random_state`. Raises ConfigError.
    """

    estimator: Any
    arguments: Any = None
    standardise: bool = False

    def __post_init__(self) -> None:
        key = "algorithm.regressor.arguments"
        if not isinstance(self.arguments, (dict, type(None))):
            raise ConfigError(key, self.arguments, "must be names and values, or null")
        try:
            self._model(0)
        except (TypeError, ValueError) as error:
            why = " ".join(str(error).split())
            raise ConfigError(key, self.arguments, why) from error

    def _model(self, seed: int) -> Any:
        from sklearn.base import clone
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        if isinstance(self.estimator, str):
            one_of("algorithm.regressor.estimator", self.estimator, _regressors())
            made = _regressors()[self.estimator]()
        else:
            made = clone(self.estimator)
        known, arguments = made.get_params(), self.arguments or {}
        for key, value in arguments.items():
            if key not in known:
                place = f"algorithm.regressor.arguments.{key}"
                raise ConfigError(place, value, did_you_mean(key, known))
        states = {k: seed for k in known if k.split("__")[-1] == "random_state"}
        made.set_params(**states | arguments)
        if hasattr(made, "_parameter_constraints"):  # or they wait for the first fit
            made._validate_params()
        return make_pipeline(StandardScaler(), made) if self.standardise else made


@dataclass(frozen=True)
class TreeKeys:
    """The YAML keys of both forests, with the paper's values."""

    trees: int = 50
    min_samples_split: int = 5
    min_samples_leaf: int = 2

    def __post_init__(self) -> None:
        at_least("algorithm.regressor.trees", self.trees, 1)
        at_least("algorithm.regressor.min_samples_split", self.min_samples_split, 2)
        at_least("algorithm.regressor.min_samples_leaf", self.min_samples_leaf, 1)


@dataclass(frozen=True)
class SklearnForest(TreeKeys, _Fitting):
    """scikit-learn's own extremely randomised trees, to compare ours with."""

    def _model(self, seed: int) -> Any:
        from sklearn.ensemble import ExtraTreesRegressor

        keys = {"min_samples_split": self.min_samples_split, "random_state": seed}
        keys["min_samples_leaf"] = self.min_samples_leaf
        return ExtraTreesRegressor(self.trees, **keys)


@functools.cache
def _regressors() -> dict[str, type]:
    """The regressors that can be made without arguments, by name."""
    from sklearn.base import RegressorMixin

    return {
        name: thing
        for module in MODULES
        for name, thing in vars(importlib.import_module(f"sklearn.{module}")).items()
        if isinstance(thing, type)
        and issubclass(thing, RegressorMixin)
        and thing is not RegressorMixin
        and not inspect.isabstract(thing)
        and all(
            p.default is not p.empty or p.kind is p.VAR_KEYWORD
            for p in inspect.signature(thing).parameters.values()
        )
    }
