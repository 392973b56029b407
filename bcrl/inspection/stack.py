"""The Q-functions of an agent, stage by stage: Q_t = α_t Q_(t-1) + ϱ_t."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bcrl.errors import BcrlError
from bcrl.learning.agent import Agent
from bcrl.learning.stage import Stage
from bcrl.learning.transfer import NEVER, tried
from bcrl.q.functions import ZERO, Q, Shaped, add, scaled
from bcrl.results.layout import SCALE
from bcrl.results.tables import read_results
from bcrl.run.agents import loaded_with_plan


@dataclass(frozen=True)
class Stack:
    """The residuals of one seed's agent, and how they make its Q."""

    agent: Agent
    stages: tuple[Stage, ...]
    residuals: tuple[Q, ...]  # ϱ_t of each stage
    alphas: tuple[float, ...]  # α_t, the factor of the base; nan in the first stage
    folded: bool  # Q was folded, so that the agent's differs from `upto` the last

    def upto(self, stage: int, without: int = 0) -> Q:
        """Q at the end of a stage, counted from 1; as if ϱ of `without` were zero."""
        q: Q = ZERO
        for n in range(1, stage + 1):
            base, own = self.base(n, q), self.residuals[n - 1]
            own = ZERO if n == without else own
            q = Shaped(base, own, base) if self.shaped and n > 1 else add(base, own)
        return q

    @property
    def shaped(self) -> bool:
        """Whether Q has the potential of shaped rewards, max_a Q_(t-1), besides."""
        start = tried(self.stages[-1].transfers)
        return start is not None and start.shape is not None

    def base(self, stage: int, before: Q) -> Q:
        """The base of a stage, given Q of the stage before."""
        alpha = self.alphas[stage - 1]
        return (
            before if alpha == 1.0 or stage == 1 else scaled(before, np.array([alpha]))
        )


def stack(run: Path, seed: int, trust: Iterable[str] = ()) -> Stack:
    """The residuals of the agent that a seed has left; BcrlError if there are none."""
    agent, plan = loaded_with_plan(run, seed, trust)
    boosting, why = plan.config["boosting"], ""
    if boosting["name"] == "off":
        why = "its method has no boosting, so that there is one Q and no residuals"
    elif plan.source is not None:
        why = "it starts from another run's agents; inspect that run, or one without "
        why += "start.from"
    elif plan.stages[-1].boost.greedy_on != "sum":
        why = "its agents act on the last residual alone (boosting=released)"
    elif len(agent.learned.residuals) < len(plan.stages):
        kept = len(agent.learned.residuals)
        why = f"its agents have {kept} of {len(plan.stages)} residuals; "
        why += "run it again with keep=stages"
    if why:
        raise BcrlError(f"{run}: {why}")
    table: Any = read_results(run)
    own = table[table.seed == seed].groupby("stage").last()
    none = [1.0] * len(plan.stages)
    alphas = own[SCALE[0]].tolist() if SCALE[0] in own else none
    folded = plan.stages[-1].boost.fold != NEVER
    return Stack(agent, plan.stages, agent.learned.residuals, (*alphas,), folded)
