"""A regression as fitted Q-iteration poses it, its fits, and a Q made of them."""

from __future__ import annotations

import textwrap
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bcrl.common.seeding import stream
from bcrl.common.serialization import DERIVED, storable
from bcrl.errors import BcrlError, ConfigError, LostSeeds
from bcrl.q.functions import Values


@storable
@dataclass(frozen=True)
class Problem:
    """One regression (one seed and action), with the points its fit is asked at.

    A fit depends on nothing else, so that a problem can be stored in a model's place.
    """

    x: NDArray[np.float32]  # (n, d)
    y: NDArray[np.float64]  # (n,)
    multiplicity: NDArray[np.int64]  # (n,) how many rows each row stands for
    queries: NDArray[np.float32]  # (m, d)
    seed: int
    path: tuple[int, ...]  # of the seed's stream "trees"

    @property
    def rng(self) -> np.random.Generator:
        """The fit's own randomness, from its beginning."""
        return stream(self.seed, "trees", *self.path)


@dataclass(frozen=True)
class Fit:
    """A fitted model and its predictions at the rows (n,) and the queries (m,)."""

    model: Any
    fitted: NDArray[np.float64]
    queried: NDArray[np.float64]


class Regressor(Protocol):
    """Fits many problems at once; constructor arguments are its YAML keys.

    `finite_only`: whether it needs an environment with finitely many states.
    `pointwise`, if it says so: no prediction depends, to the last bit, on what else is
    asked, so that it may be remembered.
    """

    finite_only: bool

    def fit(self, problems: Sequence[Problem], keep: bool, threads: int) -> list[Fit]:
        """Fits, in order; `keep=False` says that no model will be asked again."""

    def predict(
        self, models: Sequence[Any], x: Sequence[NDArray], threads: int
    ) -> list[NDArray[np.float64]]:
        """Each model's predictions (n,) at its own points (n, d)."""


@storable
@dataclass
class Fitted:
    """A model and what it was fitted to, from which it can be had again."""

    problem: Problem  # without its queries
    model: Any = field(default=None, metadata=DERIVED)

    @classmethod
    def of(cls, problem: Problem, fit: Fit) -> Fitted:
        """The model of a fit, for as long as it may be asked."""
        return cls(replace(problem, queries=problem.queries[:0]), fit.model)


Cell = tuple[int, int]  # seed, by place in its team, and action


def fit_each(
    regressor: Regressor, problems: Mapping[Cell, Problem], keep: bool, threads: int
) -> tuple[dict[Cell, Fit], dict[int, str]]:
    """Fits of `problems`, and why seeds have none; those of the others are the same."""

    def fit(cells: list[Cell]) -> list[Fit]:
        asked = [problems[cell] for cell in cells]
        fits = regressor.fit(list(map(_copied, asked)), keep, threads)
        for problem, found in zip(asked, fits, strict=True):
            for values, x in (
                (found.fitted, problem.x),
                (found.queried, problem.queries),
            ):
                _check_shape(values, len(x))
                if not np.isfinite(values).all():
                    raise BcrlError("gave a prediction that is not finite")
        return fits

    return _by_seed(regressor, "fit", fit, list(problems))


def _by_seed(
    regressor: Regressor, what: str, do: Callable[[list[Cell]], list], cells: list[Cell]
) -> tuple[dict[Cell, Any], dict[int, str]]:
    """What `do(cells)` gives; where it raises, seed by seed, and why seeds failed."""
    try:
        return dict(zip(cells, do(cells), strict=True)), {}
    except ConfigError:  # which concerns all seeds
        raise
    except Exception as error:  # whatever a regressor of the user's does
        seeds = dict.fromkeys(s for s, _ in cells)
        if len(seeds) == 1:
            return {}, dict.fromkeys(seeds, _reason(regressor, what, error))
    found, failed = {}, {}
    for seed in seeds:
        own = [cell for cell in cells if cell[0] == seed]
        some, lost = _by_seed(regressor, what, do, own)
        found, failed = found | some, failed | lost
    return found, failed


def _copied(problem: Problem) -> Problem:
    """The same problem in arrays of its own, which a regressor may change."""
    arrays = ("x", "y", "multiplicity", "queries")
    return replace(problem, **{name: getattr(problem, name).copy() for name in arrays})


def _check_shape(values: Any, n: int) -> None:
    """Raise BcrlError unless there are n predictions."""
    if np.shape(values) != (n,):
        text = f"gave predictions of shape {np.shape(values)}, expected ({n},)"
        raise BcrlError(text)


def _reason(regressor: Regressor, what: str, error: Exception) -> str:
    """Which regressor failed, how, and where in the code unless we said so."""
    text = " ".join(str(error).split())
    if not isinstance(error, BcrlError):
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"({place.filename}:{place.lineno})"
        kind = type(error).__name__
        kind = "out of memory" if isinstance(error, MemoryError) else kind
        text = f"{kind}: {text} {where}"
    name = textwrap.shorten(repr(regressor), 200)
    return f"algorithm.regressor={name}: {what} failed: {text}"


class Threads(Protocol):
    """Whoever says how many threads predictions may take."""

    @property
    def threads(self) -> int:
        """The number of threads."""


@storable
@dataclass(frozen=True)
class FittedQ:
    """Q as one model per seed and action; an action never seen predicts 0 (None)."""

    models: Sequence[Sequence[Fitted | None]]
    regressor: Regressor
    team: Threads

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        self._restore()
        cells = [
            (s, a)
            for s, row in enumerate(self.models)
            for a, fitted in enumerate(row)
            if fitted is not None and len(states[s])
        ]

        def predict(cells: list[Cell]) -> list[NDArray[np.float64]]:
            models = [self.models[s][a].model for s, a in cells]
            asked = [states[s].copy() for s, _ in cells]  # which it may change
            found = self.regressor.predict(models, asked, self.team.threads)
            for x, values in zip(asked, found, strict=True):
                _check_shape(values, len(x))
            return found

        found, failed = _by_seed(self.regressor, "predict", predict, cells)
        if failed:
            raise LostSeeds(failed)
        out = [np.zeros((len(x), n_actions)) for x in states]
        for (s, a), values in found.items():
            out[s][:, a] = values
        return np.stack(out) if isinstance(states, np.ndarray) else out

    def _restore(self) -> None:
        """Fit once more what came out of a checkpoint without its model."""
        lost = [f for row in self.models for f in row if f and f.model is None]
        if lost:
            problems = [fitted.problem for fitted in lost]
            fits = self.regressor.fit(
                list(map(_copied, problems)), True, self.team.threads
            )
            for fitted, fit in zip(lost, fits, strict=True):
                fitted.model = fit.model
