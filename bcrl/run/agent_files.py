"""The files of agents: read whole, or joined as what a batch of seeds starts from."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bcrl import __version__
from bcrl.common import serialization
from bcrl.common.identity import differences
from bcrl.common.seed_axis import joined
from bcrl.config.plan import Plan
from bcrl.envs import Env
from bcrl.errors import BcrlError, ConfigError
from bcrl.learning.learned import AGENT_SCHEMA, Learned, given
from bcrl.learning.stage import SeedBatch
from bcrl.learning.transfer import StageResult
from bcrl.q.functions import Mapped, Q
from bcrl.q.regressors.base import Fitted, FittedQ
from bcrl.results.layout import AGENT, COMPLETE, recorded_seeds, seed_path, spelled
from bcrl.results.read import read_arrays, read_document, read_recorded
from bcrl.run.memory import available

_PER_BYTE = 2  # bytes of a tree per byte of the rows that it is fitted to again
_NEAR = 1e-3  # share of Q's size that another processor's rounding may change


def start(plan: Plan, batch: SeedBatch) -> StageResult | None:
    """What the first stage starts from: the results of a source's agents, joined."""
    if (source := plan.source) is None:
        return None
    folder = Path(plan.config["start"]["from"]).absolute()
    parts, documents = [], {seed: document_of(folder, seed) for seed in batch.seeds}
    for seed, document in documents.items():
        if changed := differences(document["config"], source.config):
            key, (there, here) = next(iter(changed.items()))
            why = f"has other settings now ({key}: {there!r}, not {here!r})"
            raise BcrlError(f"start.from: {folder} {why}")
        parts.append(read_agent(folder, seed, document, source, batch).result)
    whole: StageResult = joined(parts)
    check_recorded(whole.q, source.target, folder, documents)
    if (name := plan.config["start"].get("observation")) is None:
        return whole
    return StageResult(Mapped(whole.q, name), Mapped(whole.residual, name))


def check_start(plan: Plan, seeds: Sequence[int]) -> None:
    """Raise ConfigError if the run to start from has no agents of some seeds."""
    if plan.source is None:
        return
    named = plan.config["start"]["from"]
    there = recorded_seeds(Path(named), AGENT)
    if lost := sorted(set(seeds) - set(there)):
        why = f"has no agents of seeds {spelled(lost)}; run them there first"
        raise ConfigError("start.from", named, why)


def read_agent(
    folder: Path, seed: int, document: dict[str, Any], made: Plan, batch: SeedBatch
) -> Learned:
    """What the agent's file of a seed holds; BcrlError unless the run wrote it."""
    path = seed_path(folder, seed, AGENT)
    if not path.exists():
        why = document.get("no_agent", "its run kept none")
        why = "it was removed" if AGENT in document.get("sha256", {}) else why
        todo = f"delete {path.with_suffix('')}.* and run again with keep=final"
        raise BcrlError(f"{path} is missing: {why}; {todo}")
    read_recorded(path, document)
    if (about := serialization.read_about(path)).get("schema") != AGENT_SCHEMA:
        what = f"has schema {about.get('schema')!r} of bcrl {about.get('bcrl')}"
        raise BcrlError(f"{path} {what}; bcrl {__version__} reads {AGENT_SCHEMA}")
    own = serialization.read_content(path, given(made.all_stages, batch), batch.device)
    if not isinstance(own, Learned) or about.get("seed") != seed:
        raise BcrlError(f"{path} holds no agent of seed {seed}; remove it")
    _check_models(path, own, made)
    return own


def _check_models(path: Path, own: Learned, made: Plan) -> None:
    """Raise BcrlError if models are not one per action, or need too much memory."""
    size, n_actions = 0, made.target.n_actions
    for part in serialization.parts(own):
        if isinstance(part, FittedQ) and [len(x) for x in part.models] != [n_actions]:
            raise BcrlError(f"{path} has not one model per action; remove it")
        if isinstance(part, Fitted):  # each gets its own trees
            of = part.problem
            size += of.x.nbytes + of.y.nbytes + of.multiplicity.nbytes
    regressors = (
        getattr(stage.learner, "regressor", None) for stage in made.all_stages
    )
    trees = max(getattr(regressor, "trees", 1) for regressor in regressors)
    if (needed := _PER_BYTE * size * trees) > (there := available()):
        what = f"{path} needs up to {needed / 2**30:.0f} GiB of memory for its trees"
        raise BcrlError(f"{what}, but there are {there / 2**30:.0f}")


def check_recorded(
    q: Q, env: Env, folder: Path, documents: Mapping[int, dict[str, Any]]
) -> None:
    """Compare the Q of some seeds with the values that their run has recorded.

    `documents`: the seeds' JSONs, in the order of the seeds in `q`. Warns of a
    difference like that of rounding; raises BcrlError for a larger one.
    """
    stored = []
    for seed, document in documents.items():
        read_recorded(npz := seed_path(folder, seed, "npz"), document)
        stored.append(read_arrays(npz, "states", "q"))
    values = q(np.stack([states for states, _ in stored]), env.n_actions)
    for seed, made, (_, recorded) in zip(documents, values, stored, strict=True):
        own, path = made.astype(recorded.dtype), seed_path(folder, seed, AGENT)
        if np.array_equal(own, recorded, equal_nan=True):
            continue
        near = np.inf
        if own.shape == recorded.shape:
            near = np.abs(own - recorded).max() / (1 + np.abs(recorded).max())
        if not near < _NEAR:
            why = "its Q is not the one that its run has recorded: a library's version "
            why += "differs, or a class of yours lacks field(metadata=seeds_on(0))"
            raise BcrlError(f"{path}: {why}")
        what = f"differs from the recorded one by {near:.1g} of its size"
        why = "another processor or library rounds in another way"
        warnings.warn(f"{path}: Q {what}; {why}", stacklevel=3)


def document_of(folder: Path, seed: int) -> dict[str, Any]:
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
