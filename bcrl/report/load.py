"""Reading `runs/`: complete seeds as arrays, what is odd about them as notes."""

import json
import shlex
from pathlib import Path

import numpy as np

from bcrl.common.divergence import diverging
from bcrl.errors import BcrlError
from bcrl.report.variants import COMPARED, Note, Runs, Variant, across_methods, listed
from bcrl.results.integrity import Checked, check_tree
from bcrl.results.layout import FAILED, FQI_METRICS, INDEX, family_of, state_of
from bcrl.results.read import BROKEN, INCOMPLETE

LISTED = 10  # findings that an error names


def load_runs(runs_dir: Path, scale: str, allow_incomplete: bool = False) -> Runs:
    """Everything complete under `runs_dir`/`scale`. BcrlError if there is nothing, if a
    file is broken or, unless `allow_incomplete`, if a requested seed is incomplete."""
    checked, findings = check_tree(runs_dir, scale)
    rejected = [f for f in findings if f.kind == BROKEN or not allow_incomplete]
    if rejected:
        lines = [f"nothing is drawn, because in {runs_dir / scale}:"]
        lines += [f"  {finding}" for finding in rejected[:LISTED]]
        if (more := len(rejected) - LISTED) > 0:
            shown = shlex.join(["bcrl-verify", str(runs_dir)])
            lines.append(f"  and {more} more; `{shown}` lists all")
        if any(finding.kind == INCOMPLETE for finding in rejected):
            lines.append("--allow-incomplete draws what is complete, and says so")
        raise BcrlError("\n".join(lines))
    notes: list[Note] = []
    loaded = [_variant(each, notes) for each in checked]
    runs = Runs(scale, tuple(filter(None, loaded)), notes)
    if not runs.variants:
        others = {p.parts[-4] for p in runs_dir.glob("*/*/*/seed_*.json")} - {scale}
        there = f"; there are runs at scale {listed(sorted(others))}" if others else ""
        shown = f"`{shlex.join(['bcrl', 'experiment=fig1', f'scale={scale}'])}`"
        what = f"no complete runs under {runs_dir / scale}{there}"
        raise BcrlError(f"{what}; {shown} makes those of figure 1")
    for env, family in runs.pairs:
        expected = COMPARED.get((env, family))
        for tag in sorted({v.tag or "" for v in runs.of(env, family)}):
            found = runs.tagged(env, family, tag or None)
            methods = {n: v for n, v in found.items() if n in (expected or found)}
            # A tag may be meant for one method only, so absent ones go unmentioned.
            awaited = methods if tag else expected or methods
            notes.extend(across_methods(methods, awaited, env, tag or None, family))
    return runs


def _variant(checked: Checked, notes: list[Note]) -> Variant | None:
    """A checked folder's seeds in arrays; None if it can't be drawn, with a note."""
    folder, documents, tables = checked.folder, checked.documents, checked.tables
    method, _, tag = folder.name.partition("@")

    def note(text: str, footer: str = "", incomplete: bool = False) -> None:
        about = {"footer": footer, "method": method, "incomplete": incomplete}
        text, env = f"{folder}: {text}", folder.parent.name
        notes.append(Note(text, env, tag or None, **about))

    failed = tuple(seed for seed, d in documents.items() if state_of(d) == FAILED)
    if checked.findings:
        count = f"{len(tables)} of {len(checked.requested)} seeds"
        why = "; ".join(f"{f.path.name} {f.what}" for f in checked.findings)
        also = f" ({len(failed)} failed)" if failed else ""
        text = f"INCOMPLETE, {count} drawn: {why}"
        note(text, f"{folder.name} {count}{also}", incomplete=True)
    if not tables:
        return None
    first, *_ = tables.values()
    family = family_of(first)
    needed = FQI_METRICS.get(folder.parent.name, ()) if family == "FQI" else ()
    if lacking := [name for name in needed if name not in first]:
        note(f"does not record {listed(lacking)}: left out")
        return None
    metrics = {
        str(name): np.stack([table[name].to_numpy() for table in tables.values()])
        for name in first
    }
    rows = [metrics.pop(name)[0].astype(np.int64) for name in INDEX[family]]
    for values in metrics.values():
        values[~np.isfinite(values)] = np.nan  # a gap, not a line to infinity
    sidecars = tuple(documents[seed] for seed in tables)
    made = {json.dumps([s.get("git"), s.get("versions")]) for s in sidecars}
    if len(made) > 1:
        note("seeds of different revisions or versions (see the page's provenance)")
    if far := diverging(metrics):
        which = ", ".join(f"{name} up to {value:.3g}" for name, value in far.items())
        note(f"diverges, {which}", f"{folder.name} diverges ({which})")
    return Variant(folder, family, tuple(tables), *rows, metrics, sidecars, failed)
