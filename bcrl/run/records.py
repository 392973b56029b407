"""Results on disk: one directory a composition, in it a CSV, JSON and NPZ a seed."""

from __future__ import annotations

import io
import json
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from bcrl import __version__
from bcrl.common.divergence import diverging
from bcrl.common.files import (
    is_intact,
    make_directory,
    sealed,
    seed_path,
    sha256,
    write_atomically,
    write_text,
)
from bcrl.common.identity import Plain, differences, identity
from bcrl.config.plan import Plan
from bcrl.errors import BcrlError
from bcrl.run.locks import waited_for
from bcrl.run.progress import named

SCHEMA = 2  # raised when a file's meaning changes
MALFORMED = (ValueError, LookupError, TypeError, AttributeError)  # what a file may be
LIBRARIES = ("hydra-core", "numpy", "numba", "scikit-learn", "torch", "gymnasium")


def check_directory(plan: Plan) -> None:
    """Raise BcrlError if the directory can't be written or holds another config."""
    directory = plan.directory
    existing = next(p for p in (directory, *directory.absolute().parents) if p.exists())
    if not existing.is_dir():
        raise BcrlError(f"runs_dir: {existing} is a file; name another folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise BcrlError(f"runs_dir: no permission to write in {existing}")
    present = directory / "config.yaml"
    if not present.exists():
        return
    try:
        before = yaml.safe_load(present.read_text("utf-8"))
        changed = differences(before, plan.config)
    except (yaml.YAMLError, OSError, *MALFORMED) as error:
        raise BcrlError(f"{present} can't be read ({error}); move it away") from error
    if changed:
        lines = [f"  {k}: there {a!r}, here {b!r}" for k, (a, b) in changed.items()]
        raise BcrlError(
            f"{directory} holds runs of a different config:\n" + "\n".join(lines) + "\n"
            "choose a tag of its own (tag=NAME), another runs_dir, or remove it"
        )


def pending(plan: Plan) -> list[int]:
    """The plan's seeds that are not complete yet."""
    return [seed for seed in plan.seeds if not is_complete(plan.directory, seed)]


def begin(plan: Plan) -> None:
    """Make the plan's directory, with its config, or BcrlError as `check_directory`."""
    directory = plan.directory
    make_directory(directory, "runs_dir")
    with waited_for(directory, "config"):  # others may be about to begin, too
        check_directory(plan)
        if not (directory / "config.yaml").exists():
            config = identity(plan.config)
            text = yaml.safe_dump(config, sort_keys=False, allow_unicode=True)
            write_text(directory / "config.yaml", text)


def is_complete(directory: Path, seed: int) -> bool:
    """Whether a seed's JSON, written last, says so, and its files are unchanged."""
    return _measure(directory, seed)[0]


def damaged(directory: Path, seeds: Sequence[int]) -> dict[int, str]:
    """Seeds with files of a finished run that can't count any more, and why not."""
    looks = {seed: _measure(directory, seed)[1] for seed in seeds}
    return {seed: why for seed, why in looks.items() if why}


def _measure(directory: Path, seed: int) -> tuple[bool, str]:
    stamps = []
    for suffix in ("json", "csv", "npz"):
        try:
            about = seed_path(directory, seed, suffix).stat()
            stamps.append((about.st_ino, about.st_size, about.st_ctime_ns))
        except OSError:
            stamps.append(None)
    return _checked(directory, seed, *stamps)


@lru_cache(maxsize=2**16)
def _checked(directory: Path, seed: int, *stamps: object) -> tuple[bool, str]:
    """Whether a seed is complete, and what is wrong with what a finished run left.

    The files are read once for each of their states, which `stamps` tells apart.
    """
    if stamps[0] is None:
        return False, "the JSON is missing" if any(stamps) else ""
    facts = read_facts(directory, seed)
    if not facts or not is_intact(facts):
        return False, "the JSON was changed or damaged after it was written"
    if facts.get("schema") != SCHEMA or facts.get("status") != "complete":
        return False, ""
    name = "@".join(filter(None, (facts.get("variant"), facts.get("tag"))))
    home = facts.get("scale"), facts.get("env"), name
    if (facts.get("seed"), *home) != (seed, *directory.parts[-3:]):
        return False, "the JSON is another run's"
    for suffix in ("csv", "npz"):
        try:
            data = seed_path(directory, seed, suffix).read_bytes()
        except OSError as error:
            return False, f"the {suffix.upper()} can't be read ({error.strerror})"
        if sha256(data) != facts.get("sha256", {}).get(suffix):
            return False, f"the {suffix.upper()} was changed after it was written"
    return True, ""


def status(plan: Plan, seed: int) -> str | None:
    """What a seed's JSON says: `running`, `complete` or `failed: why`; None without."""
    return read_facts(plan.directory, seed).get("status")


def write_status(plan: Plan, seed: int, status: str, facts: Plain) -> None:
    """One seed's JSON: `status` (`running`, `complete` or `failed: why`), and `facts`.

    It is sealed: its `digest` tells whether a value was changed.
    """
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


def ranges(seeds: Sequence[int]) -> list[list[int]]:
    """Seeds as [first, last] of each run of successive ones."""
    ranges: list[list[int]] = []
    for seed in sorted(seeds):
        if ranges and seed == ranges[-1][1] + 1:
            ranges[-1][1] = seed
        else:
            ranges.append([seed, seed])
    return ranges


def write_seed(
    plan: Plan,
    seed: int,
    status: str,
    rows: Sequence[Mapping[str, int | float]],
    arrays: Mapping[str, NDArray],
    facts: Plain,
) -> None:
    """One seed's CSV, NPZ and, last, JSON, which has the hashes of both."""
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


def diverged(plan: Plan) -> str | None:
    """A sentence about the plan's seeds whose values diverge, or None."""
    facts = {seed: read_facts(plan.directory, seed) for seed in plan.seeds}
    lost = {
        seed: fact["diverging"] for seed, fact in facts.items() if fact.get("diverging")
    }
    largest: dict[str, float] = {}
    for values in lost.values():
        for name, value in values.items():
            largest[name] = max(value, largest.get(name, 0.0))
    which = ", ".join(f"{name} up to {value:.3g}" for name, value in largest.items())
    return (
        f"{plan.env} {plan.name}, {named(list(lost))}: diverges, {which}"
        if lost
        else None
    )


def closing_table(plans: Sequence[Plan], seconds: float) -> str:
    """What all seeds of the plans have cost, a line a variant, as a table to print.

    `seconds`: wall-clock time of this call.
    """
    head = f"{'':32}{'seeds':>7}{'failed':>8}{'CPU s a seed':>14}{'core min':>10}"
    lines, total, peak = [head], 0.0, 0.0
    for plan in plans:
        facts = [read_facts(plan.directory, seed) for seed in plan.seeds]
        spent = [fact["cpu_seconds"] for fact in facts if "cpu_seconds" in fact]
        failed = sum(fact.get("status") != "complete" for fact in facts)
        total += sum(spent)
        peak = max(peak, *(fact.get("peak_memory_mib", 0.0) for fact in facts))
        lines.append(
            f"{plan.env + ' ' + plan.name:32}{len(facts):7}{failed:8}"
            f"{sum(spent) / max(1, len(spent)):14.2f}{sum(spent) / 60:10.1f}"
        )
    lines.append(f"{'in all':61}{total / 60:10.1f}")
    workers = plans[0].config["workers"]
    lines.append(
        f"this call: {seconds / 60:.1f} min with workers={workers}; "
        f"peak memory of a process that trains: {peak:.0f} MiB"
    )
    return "\n".join(lines)


def read_facts(directory: Path, seed: int) -> Plain:
    """A seed's metadata, nothing if it has none."""
    try:
        facts = json.loads(seed_path(directory, seed, "json").read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return facts if isinstance(facts, dict) else {}


def provenance() -> dict[str, Any]:
    """Versions, git revision and machine."""
    return {
        "command": _typed(sys.argv),
        "versions": {
            "bcrl": __version__,
            "python": platform.python_version(),
            **{name: version(name) for name in LIBRARIES},
        },
        "git": _revision(),
        "machine": {
            "system": platform.platform(),
            "processor": _processor(),
            "cores": os.cpu_count(),
        },
    }


def _typed(words: Sequence[str]) -> str:
    """A command line that can be pasted; the program without its folder."""
    program, *rest = words
    return shlex.join([Path(program).name, *rest])


def _revision() -> dict[str, Any]:
    """The git revision of the checkout that this package is part of, if it is of one.

    An installed package may lie in somebody else's.
    """
    if _git("ls-files", "--error-unmatch", "__init__.py") is None:
        return {"revision": None, "dirty": False}
    dirty = _git("status", "--porcelain") not in ("", None)
    return {"revision": _git("rev-parse", "HEAD"), "dirty": dirty}


def _git(*arguments: str) -> str | None:
    """What git says in this package's folder; None if it has nothing to say."""
    here = Path(__file__).resolve().parents[1]
    try:
        done = subprocess.run(
            ["git", "-C", str(here), *arguments],
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=10,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
    except OSError:
        return platform.processor()
    names = (line.split(":", 1)[1].strip() for line in lines if "model name" in line)
    return next(names, platform.processor())
