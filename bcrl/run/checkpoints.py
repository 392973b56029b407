"""Checkpoints: everything that a batch of seeds needs to resume where it stopped."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bcrl.common import serialization
from bcrl.common.files import write_atomically
from bcrl.common.identity import identity
from bcrl.config.plan import Plan
from bcrl.errors import BcrlError
from bcrl.results.layout import CHECKPOINT
from bcrl.run.origin import LIBRARIES
from bcrl.run.records import is_complete

_SCHEMA = 1  # raised when the content's meaning changes


def save_checkpoint(
    plan: Plan, seeds: Sequence[int], share: float, content: Any, given: Sequence[Any]
) -> None:
    """Store the batch's `content`, which refers to the objects of `given`.

    `share`: of the run, that is done.
    """
    about = _about(plan) | {"seeds": list(seeds), "share": share}
    write_atomically(
        checkpoint_path(plan, seeds),
        lambda file: serialization.write(file, about, content, given),
    )


def load_checkpoint(plan: Plan, seeds: Sequence[int], given: Sequence[Any]) -> Any:
    """The batch's stored content; BcrlError if it can't be read."""
    return serialization.read_content(checkpoint_path(plan, seeds), given, plan.device)


def checkpoint_path(plan: Plan, seeds: Sequence[int]) -> Path:
    """The file of a batch, named by its first seed and a hash of all its seeds."""
    code = hashlib.sha256(repr(tuple(seeds)).encode()).hexdigest()[:8]
    return plan.directory / f"{CHECKPOINT}{seeds[0]:04d}_{code}.npz"


def batches(plan: Plan) -> dict[tuple[int, ...], float]:
    """The batches of the plan's seeds that can resume, and each one's share done.

    A checkpoint of other code or another config counts as absent: it can't lead to the
    results of an uninterrupted run. Raises BcrlError for a damaged file.
    """
    asked, here = set(plan.seeds), _about(plan)
    found = {}
    for about in map(_read_about, _paths(plan.directory)):
        seeds, share = tuple(about.pop("seeds", ())), about.pop("share", 0.0)
        if about == here and asked.issuperset(seeds):
            found[seeds] = share
    return found


def shares(directory: Path) -> dict[int, float]:
    """The share of its run that each seed has done, by checkpoints of any code."""
    found: dict[int, float] = {}
    for path in _paths(directory):
        with suppress(BcrlError):
            about = _read_about(path)
            found |= dict.fromkeys(about.get("seeds", ()), about.get("share", 0.0))
    return found


def remove_done(plan: Plan) -> None:
    """Remove the checkpoints whose seeds are all complete."""
    for path in _paths(plan.directory):
        with suppress(BcrlError):  # `batches` will report a damaged file
            seeds = _read_about(path).get("seeds", ())
            if all(is_complete(plan.directory, seed) for seed in seeds):
                path.unlink(missing_ok=True)


def _paths(directory: Path) -> list[Path]:
    return sorted(directory.glob(f"{CHECKPOINT}*.npz"))


def _read_about(path: Path) -> dict[str, Any]:
    try:
        return serialization.read_about(path)
    except BcrlError:
        if path.exists():
            raise
        return {}  # its batch has just ended


def _about(plan: Plan) -> dict[str, Any]:
    """The facts that must be equal for a run to resume from a checkpoint."""
    config = json.dumps(identity(plan.config), sort_keys=True)
    return {
        "schema": _SCHEMA,
        "code": _code(),
        "sources": plan.sources,
        "config": hashlib.sha256(config.encode()).hexdigest(),
        "device": plan.device,
    }


def _fingerprint(sources: Iterable[Path]) -> bytes:
    return hashlib.sha256(b"".join(p.read_bytes() for p in sorted(sources))).digest()


@cache
def _code() -> str:
    """A hash of this package's code and of the libraries that compute."""
    versions = repr([version(name) for name in LIBRARIES]).encode()
    return hashlib.sha256(_OURS + versions).hexdigest()


#: Taken at the start: a file may change on disk while the loaded code stays.
_OURS = _fingerprint(Path(__file__).resolve().parents[1].rglob("*.py"))
