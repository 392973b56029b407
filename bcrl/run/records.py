"""A seed's result files: CSV, NPZ and JSON in the folder of its variant."""

import io
import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import yaml

from bcrl.common import files
from bcrl.common.divergence import diverging
from bcrl.common.identity import Plain, differences, identity
from bcrl.config.plan import Plan
from bcrl.errors import BcrlError
from bcrl.results import layout
from bcrl.results.layout import COMPLETE, CONFIG, FAILED, RUNNING, seed_path
from bcrl.results.read import Finding, read_document, read_recorded
from bcrl.run import locks

INTERRUPTED, DAMAGED, WAITING = "interrupted", "damaged", "waiting"
STATES = (COMPLETE, RUNNING, INTERRUPTED, FAILED, DAMAGED, WAITING)


def check_directory(plan: Plan) -> None:
    """Raise BcrlError if the folder can't be written or has another config's runs."""
    directory = plan.directory
    existing = next(p for p in (directory, *directory.absolute().parents) if p.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        why = "is no folder, or there is no permission to write in it"
        raise BcrlError(f"runs_dir: {existing} {why}; name another")
    present = directory / CONFIG
    try:
        changed = differences(yaml.safe_load(present.read_bytes()), plan.config)
    except FileNotFoundError:
        return
    except Exception as error:  # whatever the file holds
        raise BcrlError(f"{present} can't be read ({error}); move it away") from error
    if changed:
        lines = [f"  {k}: there {a!r}, here {b!r}" for k, (a, b) in changed.items()]
        todo = "choose another tag (tag=NAME) or runs_dir, or remove the folder"
        why = f"{directory} holds runs of a different config:"
        raise BcrlError("\n".join([why, *lines, todo]))


def make_run_directory(plan: Plan) -> None:
    """Make the plan's folder with its config.yaml; errors as `check_directory`."""
    directory = plan.directory
    files.make_directory(directory, "runs_dir")
    lock = locks.Lock(directory, "config")  # other processes may begin now, too
    if not lock.acquire(60.0):
        raise BcrlError(f"{lock.path} is held by {lock.holder()} for a minute")
    try:
        check_directory(plan)
        if not (directory / CONFIG).exists():
            options = {"sort_keys": False, "allow_unicode": True}
            text = yaml.safe_dump(identity(plan.config), **options)
            files.write_text(directory / CONFIG, text)
    finally:
        lock.release()


def state(directory: Path, seed: int) -> tuple[str, str]:
    """One of `STATES` by a seed's files, and why it failed or what is damaged.

    Complete: its JSON, written last, says so, and all files are unchanged. A seed that
    a process computes now counts as interrupted.
    """
    paths = [seed_path(directory, seed, suffix) for suffix in layout.SUFFIXES]
    if not any(map(Path.exists, paths)):
        return WAITING, ""
    try:
        document = read_document(directory, seed)
        noted, _, why = document["status"].partition(": ")
        for path in paths[1:] if noted == COMPLETE else ():
            read_recorded(path, document)
    except Finding as error:
        what = error.what.replace(f"{layout.seed_name(seed)}.json", "the JSON")
        return DAMAGED, f"the {error.path.suffix[1:].upper()} {what}"
    return INTERRUPTED if noted == RUNNING else noted, why


def problems(name: str, found: Mapping[int, tuple[str, str]]) -> list[str]:
    """Lines about failed and damaged seeds, given the `state` of each seed."""
    return by_reason(name, {s: f"{x}: {why}" for s, (x, why) in found.items() if why})


def pending(plan: Plan, seeds: Iterable[int] | None = None) -> list[int]:
    """The plan's seeds, or those of `seeds`, that are not complete yet."""
    asked = plan.seeds if seeds is None else seeds
    return [seed for seed in asked if state(plan.directory, seed)[0] != COMPLETE]


def read_facts(directory: Path, seed: int) -> Plain:
    """A seed's metadata, empty if it has none that can be read."""
    with suppress(Finding):
        return read_document(directory, seed)
    return {}


def write_status(plan: Plan, seed: int, status: str, facts: Plain) -> None:
    """Write a seed's sealed JSON; `status`: running, complete or `failed: why`."""
    document = {"schema": layout.SCHEMA, "status": status}
    document |= layout.belongs_to(plan.directory, seed)
    document |= {"asked": layout.ranges(plan.asked)} | facts | {"config": plan.config}
    files.write_text(seed_path(plan.directory, seed, "json"), files.sealed(document))


def write_seed(
    plan: Plan,
    seed: int,
    status: str,
    rows: list[Plain],
    arrays: Plain,
    facts: Plain,
    agent: bytes | None = None,
) -> None:
    """Write a seed's CSV, NPZ, agent if any, and, last, its JSON with their hashes."""
    lines = [",".join(rows[0])]
    # A value that is missing (NaN) is an empty cell, as in the report's tables.
    lines += [",".join(repr(x) if x == x else "" for x in row.values()) for row in rows]
    np.savez(packed := io.BytesIO(), **arrays)
    contents = {"npz": packed.getvalue(), "csv": "\n".join([*lines, ""]).encode()}
    seed_path(plan.directory, seed, layout.AGENT).unlink(missing_ok=True)
    if agent is not None:
        contents[layout.AGENT] = agent
    for suffix, data in contents.items():
        files.write_bytes(seed_path(plan.directory, seed, suffix), data)
    hashes = {suffix: files.sha256(data) for suffix, data in contents.items()}
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    found = {"sha256": hashes, "diverging": diverging(columns)}
    write_status(plan, seed, status, found | facts)


def named(seeds: Sequence[int]) -> str:
    """`seed 7`, `seeds 0–2, 5`."""
    return f"seed{'s' * (len(seeds) > 1)} {layout.spelled(seeds)}"


def by_reason(name: str, reasons: Mapping[int, str]) -> list[str]:
    """A line for each reason: `maze FQI, seeds 0–2: the CSV is missing`."""
    lines = []
    for why in dict.fromkeys(reasons.values()):
        seeds = [seed for seed in reasons if reasons[seed] == why]
        lines.append(f"{name}, {named(seeds)}: {why}")
    return lines
