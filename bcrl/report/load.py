"""Reading `runs/`: complete seeds as arrays, everything odd about them as notes."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bcrl.errors import BcrlError
from bcrl.report.notes import Note, across_methods, compared, listed
from bcrl.report.seedfiles import INDEX, family_of, read_csv, read_sidecar
from bcrl.report.variants import DQN_METHODS, METHODS, Runs, Variant

#: What FQI's CSVs of an environment hold after the index columns; others may hold
#: anything.
METRICS = {
    "car_on_hill": ("q_error", "return"),
    "maze": ("return", "q_error_start", "q_error", "residual_start", "solved"),
}

#: What the DQN family's CSVs hold after the index columns, in every environment.
DQN_METRICS = (
    *("return", "discounted_return", "success_rate", "q_mean", "loss"),
    *("greedy_return", "greedy_discounted_return", "greedy_success_rate"),
)
#: Columns of these that are nan wherever there was nothing to average.
MAY_BE_NAN = {"FQI": (), "DQN": ("q_mean", "loss")}

#: The methods that the figures compare: what is absent of them gets a note.
COMPARED = {
    ("car_on_hill", "FQI"): METHODS,
    ("maze", "FQI"): METHODS,
    ("linear_system", "DQN"): tuple(
        name for name in DQN_METHODS if name not in ("B-DQN", "S-DQN", "SB-DQN")
    ),
}

SCHEMA = 1  # of the records that this report reads


def _complete_seeds(
    folder: Path, env: str, tag: str | None, notes: list[Note]
) -> tuple[list[int], list[int]]:
    """A folder's complete seeds and those that diverged; a note for each left out."""
    names = (re.fullmatch(r"seed_(\d+)\.(csv|json)", p.name) for p in folder.iterdir())
    complete, failed = [], []
    for seed in sorted({int(match[1]) for match in names if match}):
        path = folder / f"seed_{seed:04d}.json"
        what = "incomplete"
        if not path.exists():
            status = f"no {path.name}"
        else:
            sidecar = read_sidecar(path, seed)
            status = f"status {sidecar.get('status')}"
            if sidecar.get("schema") != SCHEMA:
                status = f"schema {sidecar.get('schema')}, not {SCHEMA}"
        if status == "status complete":
            complete.append(seed)
            continue
        if status.startswith("status failed"):
            failed.append(seed)
            what, status = "failed", status.removeprefix("status failed").lstrip(": ")
        text = f"{folder}: seed {seed} {'is ' * (what == 'incomplete')}{what}"
        text += f" ({status}): left out" if status else ": left out"
        short = f"{folder.name}: seed {seed} {what}, left out"
        notes.append(Note(text, env, tag, short, folder.name.partition("@")[0]))
    return complete, failed


def _load_variant(folder: Path, env: str, notes: list[Note]) -> Variant | None:
    """One variant's folder, or None if it has no complete seed."""
    method, _, tag_text = folder.name.partition("@")
    tag = tag_text or None
    tables: dict[int, pd.DataFrame] = {}
    complete, failed = _complete_seeds(folder, env, tag, notes)
    for seed in complete:
        path = folder / f"seed_{seed:04d}.csv"
        table = read_csv(path)
        header = ",".join(table.columns)
        family = family_of(table)
        known = DQN_METRICS if family == "DQN" else METRICS.get(env)
        wanted = (*INDEX[family], *(known or ()))
        missing = [name for name in wanted if name not in table]
        if missing:
            text = f"{path}: header is {header}; no {listed(missing)}: left out"
            short = f"{folder.name}: seed {seed} lacks columns, left out"
            notes.append(Note(text, env, tag, short, method))
            continue
        if known and tuple(table.columns) != wanted:
            text = f"{path}: header is {header}, expected {','.join(wanted)}"
            notes.append(Note(text, env, tag))
        tables[seed] = table
    if not tables:
        notes.append(Note(f"{folder}: no complete seed", env, tag))
        return None
    return _assemble(folder, env, method, tag, tables, tuple(failed), notes)


def _assemble(
    folder: Path,
    env: str,
    method: str,
    tag: str | None,
    tables: dict[int, pd.DataFrame],
    failed: tuple[int, ...],
    notes: list[Note],
) -> Variant:
    """Stack the seeds' tables, cut to the rows that all of them have."""
    first, *others = tables
    reference = tables[first]
    family = family_of(reference)
    *_, counter = INDEX[family]
    lengths = {seed: len(table) for seed, table in tables.items()}
    rows = min(lengths.values())
    if len(set(lengths.values())) > 1:
        unit = "iterations" if family == "FQI" else "evaluations"
        groups = compared({f"seed {seed}": n for seed, n in lengths.items()})
        text = f"{folder}: {unit} differ between seeds ({groups}): cut to the least"
        short = f"{folder.name}: cut to {rows} common {unit}"
        notes.append(Note(text, env, tag, short, method))
    for seed in others:
        for column in INDEX[family]:
            ours, theirs = tables[seed].get(column), reference[column]
            if ours is None or not np.array_equal(ours[:rows], theirs[:rows]):
                raise BcrlError(
                    f"{folder}: seed_{seed:04d}.csv has another {column} column than "
                    f"seed_{first:04d}.csv, so the folder mixes two configurations: "
                    "delete the seeds of one of them and rerun"
                )
    shared = [c for c in reference if all(c in t for t in tables.values())]
    metrics = {
        str(c): np.stack([t[c].to_numpy()[:rows] for t in tables.values()])
        for c in shared
        if c not in INDEX[family]
    }
    for name, values in metrics.items():
        bad = [s for s, row in zip(tables, values, strict=True) if _bad(row)]
        if bad and name not in MAY_BE_NAN[family]:
            text = f"{folder}: {name} has non-finite values in seed {listed(bad)}"
            short = f"{folder.name}: non-finite {name}, gaps in its mean"
            notes.append(Note(text, env, tag, short, method))
        values[~np.isfinite(values)] = np.nan  # a gap, not a line to infinity
    sidecars = tuple(
        read_sidecar(folder / f"seed_{seed:04d}.json", seed) for seed in tables
    )
    notes.extend(_mixed_code(folder, env, tag, sidecars))
    stage, task, index = (
        reference[column].to_numpy()[:rows].astype(np.int64)
        for column in ("stage", "task", counter)
    )
    return Variant(
        env=env,
        method=method,
        tag=tag,
        family=family,
        folder=folder,
        seeds=tuple(tables),
        stage=stage,
        task=task,
        index=index,
        metrics=metrics,
        sidecars=sidecars,
        failed=failed,
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
            "experiment=fig2 those of figures 2, 3 and 5, experiment=fig4 those of "
            "figure 4"
        )
    runs = Runs(scale, tuple(variants), notes)
    for (env, family), expected in COMPARED.items():
        ours = [v for v in variants if (v.env, v.family) == (env, family)]
        for tag in sorted({v.tag or "" for v in ours}):
            found = runs.methods(env, tag or None, family)
            methods = {name: found[name] for name in expected if name in found}
            # A tag may be meant for one method only, so absent ones go unmentioned.
            awaited = methods if tag else expected
            notes.extend(across_methods(methods, awaited, env, tag or None, family))
    return runs
