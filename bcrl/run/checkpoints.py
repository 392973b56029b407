"""Checkpoints: what a team of seeds needs to go on exactly where it was interrupted."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bcrl.common import serialization
from bcrl.common.files import write_atomically
from bcrl.common.identity import identity
from bcrl.config.plan import Plan
from bcrl.errors import BcrlError
from bcrl.run.records import LIBRARIES, is_complete

SCHEMA = 1  # raised when the content's meaning changes

Seeds = tuple[int, ...]


def save(
    plan: Plan, seeds: Seeds, share: float, content: Any, given: Sequence[Any]
) -> None:
    """Store `content`, which refers to what is `given`, as the team's checkpoint.

    `share`: of the run, that is done.
    """
    about = _about(plan) | {"seeds": list(seeds), "share": share}
    write_atomically(
        _path(plan, seeds),
        lambda file: serialization.write(file, about, content, given),
    )


def load(plan: Plan, seeds: Seeds, given: Sequence[Any]) -> Any:
    """The team's stored content; BcrlError if it can't be read."""
    path = _path(plan, seeds)
    try:
        return serialization.read(path, given, plan.device)
    except BcrlError as error:
        raise _remedy(error) from error


def teams(plan: Plan) -> dict[Seeds, float]:
    """The teams of the plan's seeds that can go on from a checkpoint, and its share.

    BcrlError for a file that is none. One of other code or another config counts as
    absent: what it would lead to is not what an uninterrupted run gives.
    """
    asked, here = set(plan.seeds), _about(plan)
    found = {}
    for about in map(_read_about, _paths(plan.directory)):
        seeds, share = tuple(about.pop("seeds", ())), about.pop("share", 0.0)
        if about == here and asked.issuperset(seeds):
            found[seeds] = share
    return found


def shares(directory: Path) -> dict[int, float]:
    """How much of its run each seed has behind it, by checkpoints of any code."""
    found: dict[int, float] = {}
    for path in _paths(directory):
        with contextlib.suppress(BcrlError):
            about = _read_about(path)
            found |= dict.fromkeys(about.get("seeds", ()), about.get("share", 0.0))
    return found


def remove(plan: Plan, seeds: Seeds) -> None:
    """Remove a team's checkpoint, if there is one."""
    _path(plan, seeds).unlink(missing_ok=True)


def remove_done(plan: Plan) -> None:
    """Remove checkpoints all of whose seeds are complete."""
    for path in _paths(plan.directory):
        with contextlib.suppress(BcrlError):  # who asks for its seeds will be told
            seeds = _read_about(path).get("seeds", ())
            if all(is_complete(plan.directory, seed) for seed in seeds):
                path.unlink(missing_ok=True)


def _paths(directory: Path) -> list[Path]:
    return sorted(directory.glob("checkpoint_*.npz"))


def _path(plan: Plan, seeds: Seeds) -> Path:
    """Named by the first seed, and all of them."""
    code = hashlib.sha256(repr(seeds).encode()).hexdigest()[:8]
    return plan.directory / f"checkpoint_{seeds[0]:04d}_{code}.npz"


def _read_about(path: Path) -> dict[str, Any]:
    try:
        return serialization.read_about(path)
    except BcrlError as error:
        if not path.exists():  # its team has just ended
            return {}
        raise _remedy(error) from error


def _remedy(error: BcrlError) -> BcrlError:
    return BcrlError(f"{error}; remove it, its seeds then start anew")


def _about(plan: Plan) -> dict[str, Any]:
    """What must be the same for a run to go on from a checkpoint."""
    config = json.dumps(identity(plan.config), sort_keys=True)
    return {
        "schema": SCHEMA,
        "code": _code(),
        "sources": plan.sources,
        "config": hashlib.sha256(config.encode()).hexdigest(),
        "device": plan.device,
    }


def _ours() -> bytes:
    """A fingerprint of this package's sources that compute."""
    package = Path(__file__).resolve().parents[1]
    found = (p for p in package.rglob("*.py") if package / "report" not in p.parents)
    sources = (path.read_bytes() for path in sorted(found))
    return hashlib.sha256(b"".join(sources)).digest()


@cache
def _code() -> str:
    """A fingerprint of this package's sources and of the libraries that compute."""
    versions = repr([version(name) for name in LIBRARIES]).encode()
    return hashlib.sha256(OURS + versions).hexdigest()


#: Taken now, at the start: a file may change on disk, the code that runs doesn't.
OURS = _ours()
