"""Reading `runs/`: complete seeds as arrays, what is odd about them as notes."""

import json
import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bcrl.errors import BcrlError
from bcrl.report.variants import COMPARED, Note, Runs, Variant, across_methods, listed
from bcrl.results.integrity import Checked, check_folder, check_tree
from bcrl.results.layout import FAILED, FQI_METRICS, INDEX, family_of, state_of
from bcrl.results.read import BROKEN, INCOMPLETE, Finding

LISTED = 10  # findings that an error names


def load_runs(runs_dir: Path, scale: str, allow_incomplete: bool = False) -> Runs:
    """Everything complete under `runs_dir`/`scale`. BcrlError if there is nothing, if a
    file is broken or, unless `allow_incomplete`, if a requested seed is incomplete."""
    checked, findings = check_tree(runs_dir, scale)
    _reject(findings, runs_dir, f" in {runs_dir / scale}", allow_incomplete)
    notes: list[Note] = []
    loaded = [_variant(each, notes) for each in checked]
    runs = Runs(scale, tuple(filter(None, loaded)), notes)
    if not runs.variants:
        parts = [f"no complete runs under {runs_dir / scale}"]
        parts += [note.text for note in notes[:1]]
        scales = {path.parts[-4] for path in runs_dir.glob("*/*/*/seed_*.json")}
        if others := sorted(scales - {scale}):
            parts.append(f"there are runs at scale {listed(others)}")
        command = shlex.join(["bcrl", "experiment=fig1", f"scale={scale}"])
        raise BcrlError("; ".join([*parts, f"`{command}` makes those of figure 1"]))
    for env, family in runs.pairs:
        expected = COMPARED.get((env, family))
        for tag in dict.fromkeys(v.tag for v in runs.of(env, family)):
            found = runs.tagged(env, family, tag)
            methods = {n: v for n, v in found.items() if n in (expected or found)}
            # A tag may be meant for one method only, so absent ones go unmentioned.
            awaited = methods if tag else expected or methods
            notes.extend(across_methods(methods, awaited, env, tag, family))
    return runs


def load_chosen(folders: Sequence[Path], allow_incomplete: bool = False) -> Runs:
    """The variants of some folders, given as absolute paths, of any scales and
    environments, in this order."""
    checked = [check_folder(folder) for folder in folders]
    findings = [finding for each in checked for finding in each.findings]
    _reject(findings, folders[0].parents[2], "", allow_incomplete)
    notes: list[Note] = []
    variants = tuple(filter(None, [_variant(each, notes) for each in checked]))
    if not variants:
        raise BcrlError("; ".join(["no complete runs", *(note.text for note in notes)]))
    scales = dict.fromkeys(folder.parts[-3] for folder in folders)
    return Runs(listed(scales), variants, notes)


def _reject(
    findings: Sequence[Finding], runs_dir: Path, where: str, allow_incomplete: bool
) -> None:
    """Raise BcrlError for what forbids drawing, if anything does."""
    rejected = [f for f in findings if f.kind == BROKEN or not allow_incomplete]
    if not rejected:
        return
    lines = [f"nothing is drawn, because{where}:"]
    lines += [f"  {finding}" for finding in rejected[:LISTED]]
    if (more := len(rejected) - LISTED) > 0:
        command = shlex.join(["bcrl-verify", str(runs_dir)])
        lines.append(f"  and {more} more; `{command}` lists all")
    if any(finding.kind == INCOMPLETE for finding in rejected):
        lines.append("--allow-incomplete draws what is complete, and says so")
    raise BcrlError("\n".join(lines))


def _variant(checked: Checked, notes: list[Note]) -> Variant | None:
    """A checked folder's seeds in arrays; None if it can't be drawn, with a note."""
    folder, documents, tables = checked.folder, checked.documents, checked.tables
    method, _, tag = folder.name.partition("@")

    def note(text: str, footer: str = "", incomplete: bool = False) -> None:
        about = folder.parent.name, tag or None, footer, method
        notes.append(Note(f"{folder}: {text}", *about, incomplete=incomplete))

    failed = tuple(seed for seed, d in documents.items() if state_of(d) == FAILED)
    if checked.findings:
        count = f"{len(tables)} of {len(checked.requested)} seeds"
        why = "; ".join(f"{f.path.name} {f.what}" for f in checked.findings)
        also = f" ({len(failed)} failed)" if failed else ""
        footer = f"{folder.name} {count}{also}"
        note(f"INCOMPLETE, {count} drawn: {why}", footer, incomplete=True)
    if not tables:
        return None
    first, *_ = tables.values()
    family = family_of(first)
    needed = FQI_METRICS.get(folder.parent.name, ()) if family == "FQI" else ()
    if lacking := [name for name in needed if name not in first]:
        note(f"does not record {listed(lacking)}: left out")
        return None
    values = np.stack([table.to_numpy().T for table in tables.values()], axis=1)
    values[~np.isfinite(values)] = np.nan  # a gap, not a line to infinity
    metrics = dict(zip(map(str, first), values, strict=True))
    rows = [metrics.pop(name)[0].astype(np.int64) for name in INDEX[family]]
    sidecars = tuple(documents[seed] for seed in tables)
    if len({json.dumps([s.get("git"), s.get("versions")]) for s in sidecars}) > 1:
        note("seeds of different revisions or versions (see the page's provenance)")
    made = Variant(folder, family, tuple(tables), *rows, metrics, sidecars, failed)
    if made.far:
        which = ", ".join(f"{name} up to {most:.3g}" for name, most in made.far.items())
        note(f"diverges, {which}", f"{folder.name} diverges ({which})")
    return made
