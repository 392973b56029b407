"""A seed's result files: CSV, NPZ and JSON in the folder of its variant."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from bcrl.common.divergence import diverging
from bcrl.common.files import (
    make_directory,
    sealed,
    sha256,
    write_atomically,
    write_text,
)
from bcrl.common.identity import Plain, differences, identity
from bcrl.config.plan import Plan
from bcrl.errors import BcrlError
from bcrl.results.layout import (
    COMPLETE,
    CONFIG,
    FAILED,
    RUNNING,
    SCHEMA,
    SUFFIXES,
    ranges,
    seed_name,
    seed_path,
    spelled,
    state_of,
)
from bcrl.results.read import Finding, read_document, read_recorded
from bcrl.run import locks

_MALFORMED = (ValueError, LookupError, TypeError, AttributeError)  # file's content
#: Where a seed may stand; the first two and `failed: why` stand in its JSON.
STATES = (COMPLETE, RUNNING, "interrupted", FAILED, "waiting")


def check_directory(plan: Plan) -> None:
    """Raise BcrlError if the folder can't be written or has another config's runs."""
    directory = plan.directory
    existing = next(p for p in (directory, *directory.absolute().parents) if p.exists())
    if not existing.is_dir():
        raise BcrlError(f"runs_dir: {existing} is a file; name another folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise BcrlError(f"runs_dir: no permission to write in {existing}")
    present = directory / CONFIG
    if not present.exists():
        return
    try:
        before = yaml.safe_load(present.read_text("utf-8"))
        changed = differences(before, plan.config)
    except (yaml.YAMLError, OSError, *_MALFORMED) as error:
        raise BcrlError(f"{present} can't be read ({error}); move it away") from error
    if changed:
        lines = [f"  {k}: there {a!r}, here {b!r}" for k, (a, b) in changed.items()]
        raise BcrlError(
            f"{directory} holds runs of a different config:\n" + "\n".join(lines) + "\n"
            "choose another tag (tag=NAME) or runs_dir, or remove the folder"
        )


def make_run_directory(plan: Plan) -> None:
    """Make the plan's folder with its config.yaml; errors as `check_directory`."""
    directory = plan.directory
    make_directory(directory, "runs_dir")
    lock = locks.Lock(directory, "config")  # other processes may begin now, too
    if not lock.acquire(60.0):
        raise BcrlError(f"{lock.path} is held by {lock.holder()} for a minute")
    try:
        check_directory(plan)
        if not (directory / CONFIG).exists():
            config = identity(plan.config)
            text = yaml.safe_dump(config, sort_keys=False, allow_unicode=True)
            write_text(directory / CONFIG, text)
    finally:
        lock.release()


# --- a seed's state ---


def pending(plan: Plan) -> list[int]:
    """The plan's seeds that are not complete yet."""
    return [seed for seed in plan.seeds if not is_complete(plan.directory, seed)]


def is_complete(directory: Path, seed: int) -> bool:
    """Whether a seed's JSON, written last, says so, and its files are unchanged."""
    return _inspect(directory, seed)[0]


def damaged(directory: Path, seeds: Sequence[int]) -> dict[int, str]:
    """Seeds whose finished files no longer count, and why."""
    found = {seed: _inspect(directory, seed)[1] for seed in seeds}
    return {seed: why for seed, why in found.items() if why}


def state(directory: Path, seed: int) -> str:
    """One of `STATES`; a seed that is `running` without a lock was interrupted."""
    if locks.is_held(directory, seed):
        return RUNNING
    if is_complete(directory, seed):
        return COMPLETE
    noted = str(read_facts(directory, seed).get("status")).partition(":")[0]
    return {RUNNING: "interrupted", FAILED: FAILED}.get(noted, "waiting")


def _inspect(directory: Path, seed: int) -> tuple[bool, str]:
    """As `_inspected`, which reads the files once for each of their states."""
    stamps: list[object] = []
    for suffix in SUFFIXES:
        try:
            about = seed_path(directory, seed, suffix).stat()
            stamps.append((about.st_ino, about.st_size, about.st_ctime_ns))
        except OSError:
            stamps.append(None)
    return _inspected(directory, seed, *stamps) if any(stamps) else (False, "")


@lru_cache(maxsize=2**16)
def _inspected(directory: Path, seed: int, *stamps: object) -> tuple[bool, str]:
    """Whether a seed is complete, and what is wrong with its files."""
    try:
        document = read_document(directory, seed)
        if state_of(document) != COMPLETE:
            return False, ""
        for suffix in ("csv", "npz"):
            read_recorded(seed_path(directory, seed, suffix), document)
    except Finding as error:
        what = error.what.replace(f"{seed_name(seed)}.json", "the JSON")
        return False, f"the {error.path.suffix[1:].upper()} {what}"
    return True, ""


def read_facts(directory: Path, seed: int) -> Plain:
    """A seed's metadata, empty if it has none."""
    try:
        facts = json.loads(seed_path(directory, seed, "json").read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return facts if isinstance(facts, dict) else {}


# --- writing ---


def write_status(plan: Plan, seed: int, status: str, facts: Plain) -> None:
    """Write a seed's sealed JSON; `status`: running, complete or `failed: why`."""
    config = plan.config
    metadata = {
        "schema": SCHEMA,
        "status": status,
        "seed": seed,
        "scale": config["scale"]["name"],
        "env": plan.env,
        "variant": plan.variant,
        "tag": plan.tag,
        "asked": ranges(plan.asked),
        **facts,
        "config": config,
    }
    write_text(seed_path(plan.directory, seed, "json"), sealed(metadata))


def write_seed(
    plan: Plan,
    seed: int,
    status: str,
    rows: Sequence[Mapping[str, int | float]],
    arrays: Mapping[str, NDArray],
    facts: Plain,
) -> None:
    """Write a seed's CSV, NPZ and, last, its JSON with the hashes of both."""
    lines = [",".join(rows[0])]
    # A value that is missing (NaN) is an empty cell, as in the report's tables.
    lines += [",".join(repr(x) if x == x else "" for x in row.values()) for row in rows]
    text = "\n".join(lines) + "\n"
    packed = io.BytesIO()
    np.savez(packed, **dict(arrays))
    contents = {"npz": packed.getvalue(), "csv": text.encode()}
    for suffix, data in contents.items():
        path = seed_path(plan.directory, seed, suffix)
        write_atomically(path, lambda file, data=data: file.write(data))
    hashes = {suffix: sha256(data) for suffix, data in contents.items()}
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    found = {"sha256": hashes, "diverging": diverging(columns)}
    write_status(plan, seed, status, found | facts)


# --- seeds in words ---


def named(seeds: Sequence[int]) -> str:
    """`seed 7`, `seeds 0–2, 5`."""
    return f"seed{'s' * (len(seeds) > 1)} {spelled(seeds)}"


def by_reason(reasons: Mapping[int, str]) -> Iterator[tuple[str, list[int]]]:
    """Each reason with its seeds."""
    for why in dict.fromkeys(reasons.values()):
        yield why, [seed for seed, other in reasons.items() if other == why]
