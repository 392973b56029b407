"""The jobs that remain of plans: which seeds train together, and in which order."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bcrl.config.plan import Plan
from bcrl.errors import BcrlError
from bcrl.run import checkpoints, costs, records

#: By a plan's directory: its seeds that failed, and why.
Failures = dict[Path, dict[int, str]]


@dataclass(frozen=True)
class Job:
    """Seeds of a plan that train together as far as no other process has them."""

    plan: Plan
    seeds: tuple[int, ...]
    resumes: bool = False  # all of them, from a checkpoint
    threads: int = 1
    origin: Mapping[str, Any] = field(default_factory=dict)  # `origin.run_origin`

    @property
    def seconds(self) -> float:
        """Seconds of one core that the whole job is expected to take."""
        return costs.expected(self.plan) * len(self.seeds)


def merged(plans: Sequence[Plan]) -> list[Plan]:
    """The plans, those of one directory as one with the seeds of all."""
    together: dict[Path, Plan] = {}
    for plan in plans:
        before = together.get(plan.directory, plan)
        asked = tuple(dict.fromkeys(before.asked + plan.asked))
        seeds = tuple(dict.fromkeys(before.seeds + plan.seeds))
        command = "\n".join(dict.fromkeys([*before.command.splitlines(), plan.command]))
        both = replace(before, asked=asked, seeds=seeds, command=command)
        together[plan.directory] = both
    return list(together.values())


def ordered(plans: Sequence[Plan], failed: Failures) -> list[Job]:
    """The jobs that remain, the one expected to be longest first.

    A batch with a checkpoint resumes as it was. Seeds that `failed` are left out; those
    whose checkpoint can't be read are added there.
    """
    new, jobs = [], []
    for plan in plans:
        over = failed.get(plan.directory, {})
        left = [seed for seed in records.pending(plan) if seed not in over]
        try:
            begun = sorted(checkpoints.batches(plan)) if left else []
        except BcrlError as error:
            failed[plan.directory] = over | dict.fromkeys(left, str(error))
            continue
        for batch in begun:
            if set(batch) & set(left):
                jobs.append(Job(plan, batch, resumes=True))
                left = [seed for seed in left if seed not in batch]
        if left:
            new.append((plan, left))
    workers = plans[0].config["workers"]
    for plan, seeds in new:
        # Larger batches cost less per seed: on a GPU, and if all workers have variants.
        spread = 1 if plan.device == "cuda" or len(new) >= 2 * workers else workers
        least = -(-len(seeds) // plan.lockstep)  # batches of at most `lockstep` seeds
        number = min(-(-least // spread) * spread, len(seeds))  # even for the workers
        jobs += [Job(plan, tuple(p.tolist())) for p in np.array_split(seeds, number)]
    return sorted(jobs, key=lambda job: -job.seconds)
