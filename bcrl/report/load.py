"""Reading `runs/`: complete seeds as arrays, everything odd about them as notes."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bcrl.errors import BcrlError
from bcrl.report.notes import Note, across_methods, compared, listed
from bcrl.report.seedfiles import INDEX, read_arrays, read_csv, read_sidecar

#: What an environment's CSVs hold after the index columns; others may hold anything.
METRICS = {
    "car_on_hill": ("q_error", "return"),
    "maze": ("return", "q_error_start", "q_error", "residual_start", "solved"),
}

SCHEMA = 1  # of the records that this report reads

#: The methods that the figures compare, in the order of the legends.
METHODS = ("FQI", "C-FQI", "B-FQI", "BC-FQI")


@dataclass(frozen=True)
class Variant:
    """All complete seeds of one variant: S seeds, I iterations common to them.

    `stage` and `task` have shape (I,), 1-based; every array in `metrics` (S, I);
    `sidecars` are the seeds' JSON documents, in the order of `seeds`.
    """

    env: str
    method: str
    tag: str | None
    folder: Path
    seeds: tuple[int, ...]
    stage: NDArray[np.int64]
    task: NDArray[np.int64]
    metrics: dict[str, NDArray[np.float64]]
    sidecars: tuple[dict[str, Any], ...]

    @property
    def name(self) -> str:
        """The folder's name, `BC-FQI` or `BC-FQI@released`."""
        return self.folder.name

    @property
    def iterations(self) -> NDArray[np.int64]:
        """1, …, I."""
        return np.arange(1, len(self.stage) + 1)

    @property
    def optimum(self) -> float | None:
        """V*(s0) of the target task, None where it is unknown or not one number."""
        values = {sidecar.get("optimum") for sidecar in self.sidecars}
        (value,) = values if len(values) == 1 else (None,)
        return None if value is None else float(value)

    def arrays(self, seed: int, *names: str) -> list[NDArray[np.float64]]:
        """The named arrays of a seed's NPZ; BcrlError if it does not hold them."""
        return read_arrays(self.folder / f"seed_{seed:04d}.npz", *names)


@dataclass(frozen=True)
class Runs:
    """One scale's variants and the notes that reading them gave rise to."""

    scale: str
    variants: tuple[Variant, ...]
    notes: list[Note] = field(default_factory=list)

    def methods(self, env: str, tag: str | None) -> dict[str, Variant]:
        """The compared methods that are there for `env`, in the legends' order."""
        found = {v.method: v for v in self.variants if v.env == env and v.tag == tag}
        return {name: found[name] for name in METHODS if name in found}


def _complete_seeds(folder: Path, env: str, tag: str | None) -> Iterator[Note | int]:
    """The complete seeds of a variant's folder, and a note for each other one."""
    names = (re.fullmatch(r"seed_(\d+)\.(csv|json)", p.name) for p in folder.iterdir())
    for seed in sorted({int(match[1]) for match in names if match}):
        path = folder / f"seed_{seed:04d}.json"
        if not path.exists():
            status = f"no {path.name}"
        else:
            sidecar = read_sidecar(path, seed)
            status = f"status {sidecar.get('status')}"
            if sidecar.get("schema") != SCHEMA:
                status = f"schema {sidecar.get('schema')}, not {SCHEMA}"
        if status == "status complete":
            yield seed
        else:
            yield Note(
                f"{folder}: seed {seed} is incomplete ({status}): left out",
                env,
                tag,
                footer=f"{folder.name}: seed {seed} incomplete, left out",
                method=folder.name.partition("@")[0],
            )


def _load_variant(folder: Path, env: str, notes: list[Note]) -> Variant | None:
    """One variant's folder, or None if it has no complete seed."""
    method, _, tag_text = folder.name.partition("@")
    tag = tag_text or None
    tables: dict[int, pd.DataFrame] = {}
    for seed in _complete_seeds(folder, env, tag):
        if isinstance(seed, Note):
            notes.append(seed)
            continue
        path = folder / f"seed_{seed:04d}.csv"
        table = read_csv(path)
        header = ",".join(table.columns)
        wanted = (*INDEX, *METRICS.get(env, ()))
        missing = [name for name in wanted if name not in table]
        if missing:
            text = f"{path}: header is {header}; no {listed(missing)}: left out"
            short = f"{folder.name}: seed {seed} lacks columns, left out"
            notes.append(Note(text, env, tag, short, method))
            continue
        if env in METRICS and tuple(table.columns) != wanted:
            text = f"{path}: header is {header}, expected {','.join(wanted)}"
            notes.append(Note(text, env, tag))
        tables[seed] = table
    if not tables:
        notes.append(Note(f"{folder}: no complete seed", env, tag))
        return None
    return _assemble(folder, env, method, tag, tables, notes)


def _assemble(
    folder: Path,
    env: str,
    method: str,
    tag: str | None,
    tables: dict[int, pd.DataFrame],
    notes: list[Note],
) -> Variant:
    """Stack the seeds' tables, cut to the iterations that all of them have."""
    lengths = {seed: len(table) for seed, table in tables.items()}
    if len(set(lengths.values())) > 1:
        groups = compared({f"seed {seed}": n for seed, n in lengths.items()})
        text = f"{folder}: iterations differ between seeds ({groups}): cut to the least"
        short = f"{folder.name}: cut to {min(lengths.values())} common iterations"
        notes.append(Note(text, env, tag, short, method))
    rows = min(lengths.values())
    first, *others = tables
    reference = tables[first]
    for seed in others:
        for column in ("stage", "task"):
            if not np.array_equal(
                tables[seed][column][:rows], reference[column][:rows]
            ):
                raise BcrlError(
                    f"{folder}: seed_{seed:04d}.csv has another {column} column than "
                    f"seed_{first:04d}.csv, so the folder mixes two configurations: "
                    "delete the seeds of one of them and rerun"
                )
    shared = [c for c in reference if all(c in t for t in tables.values())]
    metrics = {
        str(c): np.stack([t[c].to_numpy()[:rows] for t in tables.values()])
        for c in shared
        if c not in INDEX
    }
    for name, values in metrics.items():
        bad = [s for s, row in zip(tables, values, strict=True) if _bad(row)]
        if bad:
            text = f"{folder}: {name} has non-finite values in seed {listed(bad)}"
            short = f"{folder.name}: non-finite {name}, gaps in its mean"
            notes.append(Note(text, env, tag, short, method))
            values[~np.isfinite(values)] = np.nan  # a gap, not a line to infinity
    sidecars = tuple(
        read_sidecar(folder / f"seed_{seed:04d}.json", seed) for seed in tables
    )
    notes.extend(_mixed_code(folder, env, tag, sidecars))
    return Variant(
        env=env,
        method=method,
        tag=tag,
        folder=folder,
        seeds=tuple(tables),
        stage=reference["stage"].to_numpy()[:rows].astype(np.int64),
        task=reference["task"].to_numpy()[:rows].astype(np.int64),
        metrics=metrics,
        sidecars=sidecars,
    )


def _mixed_code(
    folder: Path, env: str, tag: str | None, sidecars: tuple[dict[str, Any], ...]
) -> Iterator[Note]:
    """A note if a folder's seeds were computed by different code or libraries."""
    for what, entry, key in (
        ("git revisions", "git", "revision"),
        ("versions of numpy", "versions", "numpy"),
        ("versions of numba", "versions", "numba"),
    ):
        found = {str(s.get(entry, {}).get(key))[:10] for s in sidecars}
        if len(found) > 1:
            text = f"{folder}: seeds of different {what} ({listed(sorted(found))})"
            yield Note(text, env, tag)


def _bad(row: NDArray[np.float64]) -> bool:
    return not np.isfinite(row).all()


def load_runs(runs_dir: Path, scale: str) -> Runs:
    """Everything complete under `runs_dir`/`scale`.

    Raises BcrlError if there is nothing, or if a file of a complete seed is malformed.
    """
    root = runs_dir / scale
    notes: list[Note] = []
    variants = []
    for env_folder in sorted(p for p in root.glob("*") if p.is_dir()):
        for folder in sorted(p for p in env_folder.iterdir() if p.is_dir()):
            variant = _load_variant(folder, env_folder.name, notes)
            if variant is not None:
                variants.append(variant)
    if not variants:
        others = sorted({p.parts[-4] for p in runs_dir.glob("*/*/*/seed_*.json")})
        there = f"; there are runs at scale {listed(others)}" if others else ""
        seen = f" ({notes[0].text})" if notes else ""
        raise BcrlError(
            f"no complete runs under {root}{seen}{there}: "
            f"`bcrl experiment=fig1 scale={scale}` makes those of figure 1, "
            "experiment=fig2 those of figures 2, 3 and 5"
        )
    runs = Runs(scale, tuple(variants), notes)
    for env in METRICS:
        for tag in sorted({v.tag or "" for v in variants if v.env == env}):
            methods = runs.methods(env, tag or None)
            # A tag may be meant for one method only, so absent ones go unmentioned.
            expected = methods if tag else METHODS
            notes.extend(across_methods(methods, expected, env, tag or None))
    return runs
