"""Reading `runs/`: complete seeds as arrays, what is odd about them as notes."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bcrl.common.divergence import diverging
from bcrl.errors import BcrlError
from bcrl.report.findings import BROKEN, INCOMPLETE, Finding
from bcrl.report.integrity import Checked, check_tree
from bcrl.report.notes import Note, across_methods, listed
from bcrl.report.seedfiles import INDEX, METRICS, family_of
from bcrl.report.variants import DQN_METHODS, METHODS, Runs, Variant

#: The methods that the figures compare: what is absent of them gets a note.
COMPARED = {
    ("car_on_hill", "FQI"): METHODS,
    ("maze", "FQI"): METHODS,
    ("linear_system", "DQN"): tuple(
        name for name in DQN_METHODS if name not in ("B-DQN", "S-DQN", "SB-DQN")
    ),
}
LISTED = 10  # findings that an error names


def load_runs(runs_dir: Path, scale: str, allow_incomplete: bool = False) -> Runs:
    """Everything complete under `runs_dir`/`scale`.

    Raises BcrlError if there is nothing, if any file there is broken or, unless
    `allow_incomplete`, if any seed that was asked for is not complete.
    """
    checked, findings = check_tree(runs_dir, scale)
    _refuse(runs_dir, scale, findings, allow_incomplete)
    notes: list[Note] = []
    loaded = [_variant(each, notes) for each in checked]
    variants = tuple(variant for variant in loaded if variant is not None)
    if not variants:
        raise BcrlError(_nothing(runs_dir, scale, notes))
    runs = Runs(scale, variants, notes)
    for env, family in runs.pairs:
        expected = COMPARED.get((env, family))
        ours = [v for v in variants if (v.env, v.family) == (env, family)]
        for tag in sorted({v.tag or "" for v in ours}):
            found = runs.tagged(env, family, tag or None)
            methods = {n: v for n, v in found.items() if n in (expected or found)}
            # A tag may be meant for one method only, so absent ones go unmentioned.
            awaited = methods if tag else expected or methods
            notes.extend(across_methods(methods, awaited, env, tag or None, family))
    return runs


def _refuse(
    runs_dir: Path, scale: str, findings: list[Finding], allow_incomplete: bool
) -> None:
    """Raise BcrlError, which lists them, for findings that are not to be overlooked."""
    refused = [f for f in findings if f.kind == BROKEN or not allow_incomplete]
    if not refused:
        return
    lines = [f"nothing is drawn, because in {runs_dir / scale}:"]
    lines += [f"  {finding}" for finding in refused[:LISTED]]
    if len(refused) > LISTED:
        more = len(refused) - LISTED
        shown = shlex.join(["bcrl-verify", str(runs_dir)])
        lines.append(f"  and {more} more; `{shown}` lists all")
    if any(finding.kind == INCOMPLETE for finding in refused):
        lines.append("--allow-incomplete draws what is complete and says so in figures")
    if allow_incomplete:
        lines.append("broken files are refused with --allow-incomplete, too")
    raise BcrlError("\n".join(lines))


def _nothing(runs_dir: Path, scale: str, notes: list[Note]) -> str:
    """The message if there is no complete run."""
    others = sorted({p.parts[-4] for p in runs_dir.glob("*/*/*/seed_*.json")} - {scale})
    there = f"; there are runs at scale {listed(others)}" if others else ""
    seen = f" ({notes[0].text})" if notes else ""
    shown = shlex.join(["bcrl", "experiment=fig1", f"scale={scale}"])
    return (
        f"no complete runs under {runs_dir / scale}{seen}{there}: "
        f"`{shown}` makes those of figure 1, "
        "experiment=fig2 those of figures 2, 3 and 5, experiment=fig4 those of "
        "figure 4"
    )


def _variant(checked: Checked, notes: list[Note]) -> Variant | None:
    """A checked folder's seeds in arrays; None if it can't be drawn, with a note."""
    folder, tables = checked.folder, checked.tables
    env, (method, _, tag_text) = folder.parent.name, folder.name.partition("@")
    tag = tag_text or None
    if checked.findings:
        notes.append(_incomplete(checked, env, method, tag))
    if not tables:
        return None
    first = next(iter(tables.values()))
    family = family_of(first)
    *_, counter = INDEX[family]
    needed = METRICS.get(env, ()) if family == "FQI" else ()
    lacking = [name for name in needed if name not in first]
    if lacking:
        text = f"{folder}: does not record {listed(lacking)}: left out"
        notes.append(Note(text, env, tag, method=method))
        return None
    metrics = {
        str(name): np.stack([table[name].to_numpy() for table in tables.values()])
        for name in first
        if name not in INDEX[family]
    }
    for values in metrics.values():
        values[~np.isfinite(values)] = np.nan  # a gap, not a line to infinity
    sidecars = tuple(checked.documents.values())
    notes.extend(_mixed_code(folder, env, method, tag, sidecars))
    if far := diverging(metrics):
        which = ", ".join(f"{name} up to {value:.3g}" for name, value in far.items())
        footer = f"{folder.name} diverges ({which})"
        notes.append(Note(f"{folder}: diverges, {which}", env, tag, footer, method))
    stage, task, index = (
        first[column].to_numpy().astype(np.int64)
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
        failed=checked.failed,
    )


def _incomplete(checked: Checked, env: str, method: str, tag: str | None) -> Note:
    """How many of the seeds asked for are there, and what is the matter with others."""
    folder, failed = checked.folder, len(checked.failed)
    count = f"{len(checked.tables)} of {len(checked.asked)} seeds"
    why = "; ".join(f"{f.path.name} {f.what}" for f in checked.findings)
    lost = f" ({failed} failed)" if failed else ""
    compared = (f for (e, f), names in COMPARED.items() if e == env and method in names)
    return Note(
        text=f"{folder}: INCOMPLETE, {count} drawn: {why}",
        env=env,
        tag=tag,
        footer=f"{folder.name} {count}{lost}",
        method=method,
        family=next(compared, None),
        incomplete=True,
    )


def _mixed_code(
    folder: Path,
    env: str,
    method: str,
    tag: str | None,
    sidecars: tuple[dict[str, Any], ...],
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
            yield Note(text, env, tag, method=method)
