"""Q-functions linear in the state; a sum of them is one again."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bcrl.common.seed_axis import seeds_on
from bcrl.common.serialization import storable
from bcrl.q.functions import Q, Scaled, Sum, Values, check_states, each
from bcrl.q.regressors.base import FittedQ


@storable
@dataclass(frozen=True)
class Linear:
    """Q(s, a) = w_a · s + b_a for S seeds."""

    weights: NDArray[np.float64] = field(metadata=seeds_on(0))  # (S, d + 1, A), b last

    def __call__(self, states: Sequence[NDArray[np.float64]], n_actions: int) -> Values:
        w = self.weights
        check_states(states, len(w), w.shape[1] - 1)
        return each(states, lambda s: states[s] @ w[s, :-1] + w[s, -1])


def linear(q: Q) -> Linear | None:
    """The linear Q-function that a sum of linear models is; None for other models.

    Models are linear if scikit-learn says so (`coef_`), maybe behind StandardScalers.
    Whether they predict w · s + b is for the caller to check: some apply a function.
    """
    if isinstance(q, Linear):
        return q
    if isinstance(q, Scaled):
        own = linear(q.q)
        return own and Linear(q.factor[:, None, None] * own.weights)
    if isinstance(q, Sum):
        terms = [linear(term) for term in q.terms]
        weights = [term.weights for term in terms if term is not None]
        return Linear(np.sum(weights, 0)) if len(weights) == len(terms) else None
    if not isinstance(q, FittedQ):
        return None
    q.refit()
    lines = [_line(fitted and fitted.model) for row in q.models for fitted in row]
    known = [line for line in lines if line is not None]
    sizes = {len(line) for line in known} - {0}
    if len(known) < len(lines) or len(sizes) != 1:
        return None
    none = np.zeros(sizes.pop())  # of an action that was never tried
    whole = np.array([line if len(line) else none for line in known])
    return Linear(whole.reshape(len(q.models), -1, len(none)).swapaxes(1, 2))


def _line(model: Any) -> NDArray[np.float64] | None:
    """w and then b of a model; empty without a model, None if it is not linear."""
    if model is None:
        return np.empty(0)
    *before, last = [step for _, step in getattr(model, "steps", [("", model)])]
    if not hasattr(last, "coef_") or {type(x).__name__ for x in before} - {
        "StandardScaler"
    }:
        return None
    try:
        weights = np.asarray(last.coef_, np.float64).reshape(-1)
        offset = float(np.asarray(last.intercept_, np.float64).reshape(()))
        for scaler in reversed(before):
            weights = weights / scaler.scale_
            offset -= float(weights @ scaler.mean_)
    except (AttributeError, TypeError, ValueError):
        return None
    return np.append(weights, offset)
