"""What one seed has learned, as the content of its agent's file."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from bcrl import __version__
from bcrl.common import serialization
from bcrl.common.seed_axis import of_seed
from bcrl.common.serialization import storable
from bcrl.learning.stage import SeedBatch, Stage
from bcrl.learning.transfer import StageResult
from bcrl.q.functions import ZERO, Q

AGENT_SCHEMA = 1  # of the file; raised when the content's meaning changes


@storable
@dataclass(frozen=True)
class Learned:
    """The Q-functions of one seed at the end of a run."""

    result: StageResult  # of the last stage, without its data
    residuals: tuple[Q, ...]  # ϱ of each stage that was kept, the last one's last


def packed(
    stages: Sequence[Stage],
    batch: SeedBatch,
    result: StageResult,
    residuals: Sequence[Q],
    s: int,
) -> bytes:
    """The file of the seed with index s in a batch that has learned the stages.

    Raises TypeError for a Q-function of a class that is not storable.
    """
    own = StageResult(result.q, result.residual, acting=result.acting)
    learned = of_seed(Learned(own, tuple(residuals)), s)
    about = {"schema": AGENT_SCHEMA, "bcrl": __version__, "seed": batch.seeds[s]}
    return serialization.written(about, learned, given(stages, batch))


def given(stages: Sequence[Stage], batch: SeedBatch) -> list[Any]:
    """What a file refers to and does not contain, in an order that stays the same."""
    regressors = (getattr(stage.learner, "regressor", None) for stage in stages)
    return [ZERO, batch, *(stage.env for stage in stages), *regressors]
