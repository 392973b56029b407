"""Loading agents, which complete seeds have left beside their results."""

import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from bcrl.common import plugins
from bcrl.config.plan import Plan, recorded, unusable_config
from bcrl.errors import BcrlError, ConfigError
from bcrl.learning.agent import Agent
from bcrl.learning.stage import SeedBatch
from bcrl.results.layout import AGENT, recorded_seeds
from bcrl.run.agent_files import check_recorded, document_of, read_agent
from bcrl.run.workers import cores


def seeds_with_agents(run: Path, chosen: Iterable[int]) -> list[int]:
    """The chosen seeds, or all that have an agent; BcrlError if there are none."""
    if seeds := sorted({*chosen}) or recorded_seeds(run, AGENT):
        return seeds
    raise BcrlError(f"{run} has no agents; name a folder that a run has made")


def load(run: str | Path, seed: int = 0, *, trust: str | Iterable[str] = ()) -> Agent:
    """The agent that a complete seed of a run has left: bcrl.load("runs/…", seed=0).

    run: the folder of a variant, `<runs_dir>/<scale>/<env>/<variant>[@tag]`.
    trust: your packages that the run's config names, and that may be imported.
    Raises BcrlError if there is no such agent, or its file is not what the run wrote.
    """
    return loaded_with_plan(run, seed, trust)[0]


def loaded_with_plan(
    run: str | Path, seed: int, trust: str | Iterable[str] = ()
) -> tuple[Agent, Plan]:
    """What `load` returns, and the plan of the run."""
    folder = Path(os.path.abspath(run))  # links stay
    document = document_of(folder, seed)
    made = _plan(folder, document, [trust] if isinstance(trust, str) else trust)
    batch = SeedBatch((seed,), np.empty((0, made.target.state_dim)), cores())
    learned = read_agent(folder, seed, document, made, batch)
    check_recorded(learned.result.q, made.target, folder, {seed: document})
    return Agent(made.target, document["config"], seed, learned), made


def _plan(folder: Path, document: dict[str, Any], trust: Iterable[str]) -> Plan:
    """The plan of the run that wrote a seed's JSON."""
    config = document["config"]
    for name in trust:
        plugins.trust(name)
    try:
        return recorded(config, document["env"], document["tag"])
    except ConfigError as error:
        what = unusable_config(error)
        named = dict(plugins.named_code(config)).get(error.key, "")
        package = re.split("[.:]", named)[0]
        if named and not plugins.is_trusted(package):
            what = f"its config names code, {error.key}={named}; trust={package!r} "
            what += f"(bcrl-eval: --trust {package}) lets it be imported"
        raise BcrlError(f"{folder}: {what}") from None
