"""What is read off the DQN family's runs: target curves, pretraining, late averages."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bcrl.report.variants import Methods, Variant

LINEAR = "linear_system"
WINDOW = 5000  # environment steps before a run's end whose evaluations are averaged

#: A learner's name in the records → in the figures.
LEARNER_NAMES = {"lspi": "LSPI", "dqn": "DQN on LQ"}


def target_rows(variant: Variant) -> NDArray[np.intp]:
    """Rows that were measured in the target, which is the last task, (T,)."""
    return np.flatnonzero(variant.task == variant.task[-1])


def late_rows(variant: Variant) -> NDArray[np.intp]:
    """The target's rows within the last WINDOW steps, never none."""
    rows = target_rows(variant)
    return rows[variant.index[rows] > variant.index[-1] - WINDOW]


def late(variant: Variant, metric: str) -> NDArray[np.float64]:
    """Every seed's mean over the evaluations of the last WINDOW steps, (S,)."""
    return variant.metrics[metric][:, late_rows(variant)].mean(axis=1)


def area(variant: Variant, metric: str) -> NDArray[np.float64]:
    """Every seed's mean over all evaluations in the target, (S,)."""
    return variant.metrics[metric][:, target_rows(variant)].mean(axis=1)


def pretraining_rows(variant: Variant) -> NDArray[np.intp]:
    """Rows of a first stage on another task than the target; may be none, (P,)."""
    return np.flatnonzero((variant.stage == 1) & (variant.task != variant.task[-1]))


def first_learner(variant: Variant) -> str:
    """`lspi` or `dqn`, whichever trains the first stage (recorded in the JSON)."""
    return str(variant.sidecars[0]["learners"][0])


def pretraining(methods: Methods) -> dict[str, Variant]:
    """A variant that shows each learner's pretraining: the one with most seeds.

    Methods that pretrain with the same learner share that stage, draw by draw.
    """
    found: dict[str, Variant] = {}
    for variant in sorted(methods.values(), key=lambda v: -len(v.seeds)):
        if len(pretraining_rows(variant)):
            found.setdefault(first_learner(variant), variant)
    return {learner: found[learner] for learner in LEARNER_NAMES if learner in found}


def switches(methods: Methods) -> dict[tuple[str, int], str]:
    """Where pretraining ends: (learner, environment steps) → its label."""
    found = {}
    for variant in methods.values():
        rows = pretraining_rows(variant)
        if len(rows):
            learner = first_learner(variant)
            label = f"{LEARNER_NAMES.get(learner, learner)} → target"
            found[learner, int(variant.index[rows[-1]])] = label
    return found
