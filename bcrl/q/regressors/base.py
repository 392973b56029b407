"""The regression problems of fitted Q-iteration, their fits, and a Q made of fits."""

import textwrap
import traceback
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bcrl.common.seed_axis import seeds_on
from bcrl.common.seeding import stream
from bcrl.common.serialization import DERIVED, storable
from bcrl.errors import BcrlError, ConfigError, LostSeeds
from bcrl.q.functions import Values, each


@storable
@dataclass(frozen=True)
class Problem:
    """The regression of one seed and action, and all that its fit depends on."""

    x: NDArray[np.float32]  # (n, d)
    y: NDArray[np.float64]  # (n,)
    multiplicity: NDArray[np.int64]  # (n,): how many equal rows each row stands for
    queries: NDArray[np.float32]  # (m, d): the points to predict at
    seed: int
    path: tuple[int, ...]  # of the seed's stream "trees"

    @property
    def rng(self) -> np.random.Generator:
        """This fit's random stream, from its beginning."""
        return stream(self.seed, "trees", *self.path)


@dataclass(frozen=True)
class Fit:
    """A fitted model and its predictions at the rows (n,) and the queries (m,)."""

    model: Any
    fitted: NDArray[np.float64]
    queried: NDArray[np.float64]


class Regressor(Protocol):
    """Fits many problems at once; its constructor's arguments are its YAML keys.

    finite_only: whether it needs an environment with finitely many states. With
    `pointwise = True`, predictions may be cached: none depends on the other points.
    """

    finite_only: bool

    def fit(self, problems: Sequence[Problem], keep: bool, threads: int) -> list[Fit]:
        """The fits, in order; with `keep=False` no model needs to predict again."""

    def predict(
        self, models: Sequence[Any], x: Sequence[NDArray], threads: int
    ) -> list[NDArray[np.float64]]:
        """Each model's predictions (n,) at its own points (n, d)."""


@storable
@dataclass
class Fitted:
    """A model and the problem that it can be fitted to again."""

    problem: Problem  # without its queries
    model: Any = field(default=None, metadata=DERIVED)

    @classmethod
    def of(cls, problem: Problem, fit: Fit) -> "Fitted":
        """The model of a fit, without the fit's predictions."""
        return cls(replace(problem, queries=problem.queries[:0]), fit.model)


Cell = tuple[int, ...]  # a seed's index in its batch, an action; the term of a sum


def fit_each(
    regressor: Regressor, problems: Mapping[Cell, Problem], keep: bool, threads: int
) -> tuple[dict[Cell, Fit], dict[int, str]]:
    """The fits of `problems`, and why seeds failed; a failure changes no other seed."""

    def fit(cells: list[Cell]) -> list[Fit]:
        own = [problems[cell] for cell in cells]
        copies = [deepcopy(problem) for problem in own]  # a regressor may change them
        fits = regressor.fit(copies, keep, threads)
        for problem, fit in zip(own, fits, strict=True):
            _check_shape(fit.fitted, len(problem.x))
            _check_shape(fit.queried, len(problem.queries))
            if not (np.isfinite(fit.fitted).all() and np.isfinite(fit.queried).all()):
                raise BcrlError("a prediction is not finite")
        return fits

    return _by_seed(regressor, "fit", fit, list(problems))


def _by_seed(
    regressor: Regressor, what: str, do: Callable[[list[Cell]], list], cells: list[Cell]
) -> tuple[dict[Cell, Any], dict[int, str]]:
    """The results of `do(cells)`, seed by seed if it raises, and why seeds failed."""
    try:
        return dict(zip(cells, do(cells), strict=True)), {}
    except ConfigError:  # concerns all seeds
        raise
    except Exception as error:  # a user's regressor may raise anything
        seeds = dict.fromkeys(cell[0] for cell in cells)
        if len(seeds) == 1:
            return {}, dict.fromkeys(seeds, _reason(regressor, what, error))
    found: dict[Cell, Any] = {}
    failed: dict[int, str] = {}
    for seed in seeds:
        own = [cell for cell in cells if cell[0] == seed]
        some, lost = _by_seed(regressor, what, do, own)
        found, failed = found | some, failed | lost
    return found, failed


def _check_shape(values: Any, n: int) -> None:
    if (shape := np.shape(values)) != (n,):
        raise BcrlError(f"predictions have the shape {shape}, expected ({n},)")


def _reason(regressor: Regressor, what: str, error: Exception) -> str:
    """Which regressor failed and why; for a foreign error also where in the code."""
    text = " ".join(str(error).split())
    if not isinstance(error, BcrlError):
        place = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {text} ({place.filename}:{place.lineno})"
    name = textwrap.shorten(repr(regressor), 200)
    return f"algorithm.regressor={name}: {what} failed: {text}"


FEW = 1000  # states; more take much memory, since each model has its own copy


@storable
@dataclass(frozen=True)
class FittedQ:
    """Q as one model per seed and action; an unseen action (None) has the value 0."""

    models: Sequence[Sequence[Fitted | None]] = field(metadata=seeds_on(0))
    regressor: Regressor
    team: Any  # its `threads` may be used

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        return self.together([self], states, n_actions)[0]

    def refit(self) -> None:
        """Fit again the models that a file has left out."""
        every = [fitted for row in self.models for fitted in row]
        lost = [fitted for fitted in every if fitted and fitted.model is None]
        problems = [deepcopy(fitted.problem) for fitted in lost]
        fits = self.regressor.fit(problems, True, self.team.threads) if lost else []
        for fitted, fit in zip(lost, fits, strict=True):
            fitted.model = fit.model

    @staticmethod
    def together(
        terms: "Sequence[FittedQ]", states: Sequence[NDArray], n_actions: int
    ) -> list[Values]:
        """The values of each term; at few states all are predicted in one call.

        A boosted Q is a sum of many terms, and an episode's step queries few states.
        """
        regressor, threads = terms[0].regressor, terms[0].team.threads
        mixed = any(term.regressor is not regressor for term in terms)
        if len(terms) > 1 and (mixed or sum(map(len, states)) > FEW):
            return [term(states, n_actions) for term in terms]
        for term in terms:
            term.refit()
        models: dict[Cell, Any] = {
            (s, a, k): fitted.model
            for k, term in enumerate(terms)
            for s, row in enumerate(term.models)
            for a, fitted in enumerate(row)
            if fitted is not None and len(states[s])
        }

        def predict(cells: list[Cell]) -> list[NDArray[np.float64]]:
            own = [models[cell] for cell in cells]
            points = [states[s].copy() for s, *_ in cells]  # it may change them
            found = regressor.predict(own, points, threads)
            for x, values in zip(points, found, strict=True):
                _check_shape(values, len(x))
            return found

        found, failed = _by_seed(regressor, "predict", predict, list(models))
        if failed:
            raise LostSeeds(failed)
        out = [[np.zeros((len(x), n_actions)) for x in states] for _ in terms]
        for (s, a, k), values in found.items():
            out[k][s][:, a] = values
        return [each(states, own.__getitem__) for own in out]
