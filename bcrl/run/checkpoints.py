"""Checkpoints: everything that a batch of seeds needs to resume where it stopped."""

import json
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bcrl.common import serialization
from bcrl.common.files import sha256, write_atomically
from bcrl.common.identity import identity
from bcrl.config.plan import Plan
from bcrl.errors import BcrlError
from bcrl.results.layout import CHECKPOINT
from bcrl.run.origin import LIBRARIES
from bcrl.run.records import pending

_SCHEMA = 1  # raised when the content's meaning changes
#: Our code and the libraries that compute, as they are at the start: a file may change
#: on disk while the loaded code stays.
_OURS = [p.read_bytes() for p in sorted(Path(__file__).parents[1].rglob("*.py"))]
_CODE = sha256(b"".join(_OURS) + repr([version(name) for name in LIBRARIES]).encode())


def save_checkpoint(
    plan: Plan,
    seeds: Sequence[int],
    content: Any,
    given: Sequence[Any],
    kind: str = CHECKPOINT,
) -> None:
    """Store the batch's `content`, which refers to the objects of `given`."""
    about = about_of(plan) | {"seeds": list(seeds)}
    write_atomically(
        checkpoint_path(plan, seeds, kind),
        lambda to: serialization.write_content(to, about, content, given),
    )


def checkpoint_path(plan: Plan, seeds: Sequence[int], kind: str = CHECKPOINT) -> Path:
    """The file of a batch, named by its first seed and a hash of all its seeds."""
    code = sha256(repr(tuple(seeds)).encode())[:8]
    return plan.directory / f"{kind}{seeds[0]:04d}_{code}.npz"


def batches(plan: Plan) -> set[tuple[int, ...]]:
    """The batches that can resume, also those with seeds of other parts of the run.

    A checkpoint of other code or another config counts as absent: it can't lead to the
    results of an uninterrupted run. Raises BcrlError for a damaged file.
    """
    asked, here, found = set(plan.asked), about_of(plan), set()
    for about in stored(plan.directory).values():
        if "error" in about:
            raise about["error"]
        seeds = tuple(about.pop("seeds", ()))
        if about == here and asked.issuperset(seeds):
            found.add(seeds)
    return found


def remove_done(plan: Plan) -> None:
    """Remove the checkpoints whose seeds are all complete."""
    for path, about in stored(plan.directory).items():
        seeds = about.get("seeds", ())
        if seeds and not pending(plan, seeds):
            path.unlink(missing_ok=True)


def stored(directory: Path, kind: str = CHECKPOINT) -> dict[Path, dict[str, Any]]:
    """What each checkpoint says about itself, or the `error` of reading it."""
    found = {}
    for path in sorted(directory.glob(f"{kind}*.npz")):
        try:
            found[path] = serialization.read_about(path)
        except BcrlError as error:
            if path.exists():  # otherwise its batch has just ended
                found[path] = {"error": error}
    return found


def about_of(plan: Plan) -> dict[str, Any]:
    """The facts that must be equal for a run to resume from a checkpoint."""
    config = sha256(json.dumps(identity(plan.config), sort_keys=True).encode())
    about = {"schema": _SCHEMA, "code": _CODE, "sources": plan.sources}
    return about | {"config": config, "device": plan.device}
