"""Loading agents, which complete seeds have left beside their results."""

import re
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from bcrl import __version__
from bcrl.common import plugins, serialization
from bcrl.config.plan import Plan, plan
from bcrl.errors import BcrlError, ConfigError
from bcrl.learning.agent import Agent
from bcrl.learning.learned import AGENT_SCHEMA, Learned, given
from bcrl.learning.stage import SeedBatch
from bcrl.results.layout import AGENT, COMPLETE, recorded_seeds, seed_path, spelled
from bcrl.results.read import read_arrays, read_document, read_recorded
from bcrl.run.memory import available
from bcrl.run.workers import cores

_NEAR = 1e-3  # share of Q's size that another processor's rounding may change
_PER_BYTE = 2  # bytes of a tree per byte of the rows that it is fitted to again


def load(run: str | Path, seed: int = 0, *, trust: str | Iterable[str] = ()) -> Agent:
    """The agent that a complete seed of a run has left: bcrl.load("runs/…", seed=0).

    run: the folder of a variant, `<runs_dir>/<scale>/<env>/<variant>[@tag]`.
    trust: your packages that the run's config names, and that may be imported.
    Raises BcrlError if there is no such agent, or its file is not what the run wrote.
    """
    folder = Path(run).absolute()
    document = _document(folder, seed)
    path = seed_path(folder, seed, AGENT)
    if not path.exists():
        why = document.get("no_agent", "its run had keep=none, or it was removed")
        todo = f"delete {path.with_suffix('')}.* and run again with keep=final"
        raise BcrlError(f"{path} is missing: {why}; {todo}")
    size = len(read_recorded(path, document))
    if (about := serialization.read_about(path)).get("schema") != AGENT_SCHEMA:
        made = f"has schema {about.get('schema')!r} of bcrl {about.get('bcrl')}"
        raise BcrlError(
            f"{path} {made}; bcrl {__version__} reads schema {AGENT_SCHEMA}"
        )
    made = _plan(path, document, [trust] if isinstance(trust, str) else trust)
    regressors = (getattr(stage.learner, "regressor", None) for stage in made.stages)
    trees = max(getattr(regressor, "trees", 0) for regressor in regressors)
    if (needed := _PER_BYTE * size * trees) > (there := available()):
        what = f"{path} needs up to {needed / 2**30:.0f} GiB of memory for its trees"
        raise BcrlError(f"{what}, but there are {there / 2**30:.0f}")
    if made.family == "DQN":  # FQI does without torch, which is slow to import
        from bcrl.q.networks import mlp  # noqa: F401 (a file holds its classes)
    batch = SeedBatch((seed,), np.empty((0, made.target.state_dim)), cores())
    own = serialization.read_content(path, given(made.stages, batch))
    if not isinstance(own, Learned):
        raise BcrlError(f"{path} holds no agent; remove it")
    agent = Agent(made.target, document["config"], seed, own)
    _compare(agent, seed_path(folder, seed, "npz"), document)
    return agent


def _document(folder: Path, seed: int) -> dict[str, Any]:
    """A complete seed's JSON; BcrlError says which seeds there are."""
    if not folder.is_dir():
        why = "is no folder; name one such as runs/quick/maze/BC-FQI"
        raise BcrlError(f"{folder} {why}")
    seeds = recorded_seeds(folder, "json")
    if seed not in seeds:
        there = f"seeds {spelled(seeds)}" if seeds else "no seeds"
        raise BcrlError(f"{folder} has no seed {seed}; there are {there}")
    document = read_document(folder, seed)
    if document["status"] != COMPLETE:
        why = f'says "{document["status"]}"; run its command to the end'
        raise BcrlError(f"{seed_path(folder, seed, 'json')} {why}")
    return document


def _plan(path: Path, document: dict[str, Any], trust: Iterable[str]) -> Plan:
    """The plan of the run that wrote a seed's JSON."""
    config = document["config"]
    for name in trust:
        plugins.trust(name)
    named = dict(plugins.named_code(config))
    try:
        return plan(config, document["env"], document["tag"])
    except ConfigError as error:
        what = f"its config can't be used by bcrl {__version__}: {error}"
        if error.key in named and not plugins.is_trusted(named[error.key]):
            package = re.split("[.:]", named[error.key])[0]
            what = f"its config names code, {error.key}={named[error.key]}; "
            what += f"trust={package!r} lets it be imported"
        raise BcrlError(f"{path}: {what}") from error


def _compare(agent: Agent, npz: Path, document: dict[str, Any]) -> None:
    """Compare an agent's Q with the one that its run has recorded."""
    read_recorded(npz, document)
    states, recorded = read_arrays(npz, "states", "q")
    own = agent.values(agent.learned.result.q, states).astype(recorded.dtype)
    if np.array_equal(own, recorded, equal_nan=True):
        return
    if own.shape == recorded.shape:
        difference = float(np.abs(own - recorded).max() / (1 + np.abs(recorded).max()))
        if difference < _NEAR:
            what = f"differs from the recorded one by {difference:.1g} of its size"
            why = "another processor or library rounds in another way"
            warnings.warn(f"{npz.with_suffix('')}: Q {what}; {why}", stacklevel=3)
            return
    why = "its Q is not the one that its run has recorded; versions of libraries differ"
    raise BcrlError(f"{npz.with_suffix(f'.{AGENT}')}: {why}")
