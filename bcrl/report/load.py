"""Reading `runs/`: complete seeds as arrays, what is odd about them as notes."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np

from bcrl.common.divergence import diverging
from bcrl.errors import BcrlError
from bcrl.report.notes import across_methods, listed
from bcrl.report.variants import COMPARED, Note, Runs, Variant
from bcrl.results.integrity import Checked, check_tree
from bcrl.results.layout import FQI_METRICS, INDEX, family_of
from bcrl.results.read import BROKEN, INCOMPLETE, Finding

LISTED = 10  # findings that an error names


def load_runs(runs_dir: Path, scale: str, allow_incomplete: bool = False) -> Runs:
    """Everything complete under `runs_dir`/`scale`.

    Raises BcrlError if there is nothing, if any file there is broken or, unless
    `allow_incomplete`, if any requested seed is not complete.
    """
    checked, findings = check_tree(runs_dir, scale)
    _reject(runs_dir, scale, findings, allow_incomplete)
    notes: list[Note] = []
    loaded = [_variant(each, notes) for each in checked]
    variants = tuple(variant for variant in loaded if variant is not None)
    if not variants:
        raise BcrlError(_nothing(runs_dir, scale, notes))
    runs = Runs(scale, variants, notes)
    for env, family in runs.pairs:
        expected = COMPARED.get((env, family))
        for tag in sorted({v.tag or "" for v in runs.of(env, family)}):
            found = runs.tagged(env, family, tag or None)
            methods = {n: v for n, v in found.items() if n in (expected or found)}
            # A tag may be meant for one method only, so absent ones go unmentioned.
            awaited = methods if tag else expected or methods
            notes.extend(across_methods(methods, awaited, env, tag or None, family))
    return runs


def _reject(
    runs_dir: Path, scale: str, findings: list[Finding], allow_incomplete: bool
) -> None:
    """Raise BcrlError, which lists them, for findings that are not to be overlooked."""
    rejected = [f for f in findings if f.kind == BROKEN or not allow_incomplete]
    if not rejected:
        return
    lines = [f"nothing is drawn, because in {runs_dir / scale}:"]
    lines += [f"  {finding}" for finding in rejected[:LISTED]]
    if len(rejected) > LISTED:
        more = len(rejected) - LISTED
        shown = shlex.join(["bcrl-verify", str(runs_dir)])
        lines.append(f"  and {more} more; `{shown}` lists all")
    if any(finding.kind == INCOMPLETE for finding in rejected):
        lines.append("--allow-incomplete draws what is complete and says so in figures")
    if allow_incomplete:
        lines.append("broken files are rejected with --allow-incomplete, too")
    raise BcrlError("\n".join(lines))


def _nothing(runs_dir: Path, scale: str, notes: list[Note]) -> str:
    """The message if there is no complete run."""
    others = sorted({p.parts[-4] for p in runs_dir.glob("*/*/*/seed_*.json")} - {scale})
    there = f"; there are runs at scale {listed(others)}" if others else ""
    seen = f" ({notes[0].text})" if notes else ""
    shown = shlex.join(["bcrl", "experiment=fig1", f"scale={scale}"])
    return (
        f"no complete runs under {runs_dir / scale}{seen}{there}: `{shown}` makes "
        "those of figure 1, experiment=fig2 those of figures 2, 3 and 5, "
        "experiment=fig4 those of figure 4"
    )


def _variant(checked: Checked, notes: list[Note]) -> Variant | None:
    """A checked folder's seeds in arrays; None if it can't be drawn, with a note."""
    folder, tables = checked.folder, list(checked.tables.values())
    if checked.findings:
        notes.append(_incomplete(checked))
    if not tables:
        return None
    family = family_of(tables[0])
    *_, counter = index = INDEX[family]
    needed = FQI_METRICS.get(folder.parent.name, ()) if family == "FQI" else ()
    if lacking := [name for name in needed if name not in tables[0]]:
        text = f"does not record {listed(lacking)}: left out"
        notes.append(Note.of(folder, text))
        return None
    metrics = {
        str(name): np.stack([table[name].to_numpy() for table in tables])
        for name in tables[0]
        if name not in index
    }
    for values in metrics.values():
        values[~np.isfinite(values)] = np.nan  # a gap, not a line to infinity
    sidecars = tuple(checked.documents.values())
    for what, entry, key in (
        ("git revisions", "git", "revision"),
        ("versions of numpy", "versions", "numpy"),
        ("versions of numba", "versions", "numba"),
    ):
        found = {str(s.get(entry, {}).get(key))[:10] for s in sidecars}
        if len(found) > 1:
            text = f"seeds of different {what} ({listed(sorted(found))})"
            notes.append(Note.of(folder, text))
    if far := diverging(metrics):
        which = ", ".join(f"{name} up to {value:.3g}" for name, value in far.items())
        footer = f"{folder.name} diverges ({which})"
        notes.append(Note.of(folder, f"diverges, {which}", footer))
    stage, task, rows = (
        tables[0][name].to_numpy().astype(np.int64)
        for name in ("stage", "task", counter)
    )
    seeds, failed = tuple(checked.tables), checked.failed
    return Variant(folder, family, seeds, stage, task, rows, metrics, sidecars, failed)


def _incomplete(checked: Checked) -> Note:
    """How many requested seeds are complete, and what is the matter with others."""
    folder, failed = checked.folder, len(checked.failed)
    count = f"{len(checked.tables)} of {len(checked.requested)} seeds"
    why = "; ".join(f"{f.path.name} {f.what}" for f in checked.findings)
    footer = f"{folder.name} {count}" + (f" ({failed} failed)" if failed else "")
    note = Note.of(folder, f"INCOMPLETE, {count} drawn: {why}", footer, incomplete=True)
    for (env, family), names in COMPARED.items():
        if env == note.env and note.method in names:
            return replace(note, family=family)
    return note
