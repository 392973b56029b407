"""Tables of the suite, as Markdown and CSV, and the list of written files."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bcrl.common.files import write_text
from bcrl.errors import BcrlError
from bcrl.report.tables import TextTable
from research.misleading_figures import figure_finals, figure_matrix, save
from research.misleading_measures import (
    Kept,
    Measures,
    Scale,
    kept_gain,
    measure,
    scale_of,
    summary,
)
from research.misleading_runs import Job, cell, load
from research.misleading_tasks import ALONE, IN_MATRIX, METHODS, ONLY, Setting

#: A line search, and what it is compared with.
_PAIRS = {f"{name} line search": name for name in ("B", "BC", "SBC")}
_HEAD = """# Negative transfer, measured

[The protocol](../explanation/negative_transfer.md) explains the tasks, the measures and
the verdicts. `python -m research.misleading table` writes this page. Differences from
plain are shares of plain's own gain r1 − r0, in %, with 95 % intervals.
"""
_FINALS = "![Final return by scenario and method](misleading_finals.png)\n"
_MATRIX = "![Area gained by source and target task](misleading_matrix.png)\n"
Found = dict[tuple[str, str, str], Measures]


def write(
    settings: Mapping[str, Setting], jobs: Sequence[Job], out: Path, to: Path
) -> list[Path]:
    """Write tables and figures into `to`, from the jobs' files in `out`."""
    frames = load(jobs, out)
    found, scales = _measured(settings, frames)
    if not found:
        why = "has no run with these settings and seeds in which plain gains something"
        raise BcrlError(f"--out {out}: {why}; `run` makes them")
    table = summary(found, scales)
    revisions = sorted({str(x) for f in frames.values() for x in f.revision.dropna()})
    seeds = jobs[0].seeds
    facts = f"Seeds {seeds[0]} to {seeds[-1]}; {len(frames)} of {len(jobs)} jobs are "
    code = ", ".join(revisions) or "unknown"
    parts = [_HEAD, f"{facts}complete. Revision: {code}.\n"]
    gains = {e: _gains(e, s, frames) for e, s in settings.items() if s.matrix}
    parts += [_verdicts(table), _kept(found), _FINALS, _MATRIX * bool(gains)]
    parts += [_environment(env, table, scales[env]) for env in scales]
    if lost := ", ".join(env for env in settings if env not in scales):
        parts.append(f"Plain's gain is not above 0 or not known: {lost}.\n")
    files = [write_text(to / "misleading.md", "\n".join(parts))]
    text = table.to_csv(index=False, float_format="%.4g", lineterminator="\n")
    files.append(write_text(to / "misleading_measures.csv", text))
    files.append(write_text(to / "misleading.csv", _finals(found, seeds)))
    files += save(figure_finals(table), to, "misleading_finals")
    if gains:
        files += save(figure_matrix(gains), to, "misleading_matrix")
    return files


def _measured(
    settings: Mapping[str, Setting], frames: Mapping[tuple[str, str, str], pd.DataFrame]
) -> tuple[Found, dict[str, Scale]]:
    """The measures of all scenarios, and each environment's scale."""
    found: Found = {}
    scales: dict[str, Scale] = {}
    for env, setting in settings.items():
        plain = frames.get((env, ONLY, "plain"))
        scale = None if plain is None else scale_of(plain, setting.late)
        if scale is None:
            continue
        scales[env] = scale
        for (own, curriculum, method), frame in frames.items():
            if own == env and curriculum in setting.curricula():
                alone = method in ALONE
                found[env, curriculum, method] = measure(
                    frame, scale, setting.late, alone
                )
    return found, scales


def _gains(
    env: str, setting: Setting, frames: Mapping[tuple[str, str, str], pd.DataFrame]
) -> dict[str, pd.DataFrame]:
    """Area gained over plain as a share of plain's gain: the method → source × target.

    nan where a run is missing or plain gains nothing; the diagonal has B.
    """
    names = [*setting.matrix_tasks()]
    found = {}
    for method in IN_MATRIX:
        cells = pd.DataFrame(np.nan, names, names)
        for goal in names:
            plain = frames.get((env, cell(goal, goal), "plain"))
            scale = None if plain is None else scale_of(plain, setting.late)
            if plain is None or scale is None:
                continue
            base = measure(plain, scale, setting.late, True).area
            for source in names:
                own = method.replace("BC", "B") if source == goal else method
                frame = frames.get((env, cell(source, goal), own))
                if frame is not None:
                    area = measure(frame, scale, setting.late, source == goal).area
                    cells.loc[source, goal] = (area - base).mean() / scale.gain
        easier = {"helpful": "easier"}  # a task, not what it does
        found[method] = cells.rename(index=easier, columns=easier)
    return found


def _rows(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return str(TextTable([dict(zip(head, row, strict=True)) for row in rows]))


def _percent(value: float) -> str:
    return f"{round(100 * value)}".replace("-", "−") if np.isfinite(value) else "–"


def _with_interval(row: Any, name: str) -> str:
    low, high = _percent(row[f"{name}_low"]), _percent(row[f"{name}_high"])
    return f"{_percent(row[name])} [{low}, {high}]"


def _verdicts(table: pd.DataFrame) -> str:
    """How often each method ends worse than plain, over all scenarios."""
    rows = []
    for method in METHODS:
        own = table[(table.method == method) & (table.verdict != "")]
        if len(own):
            words = ("not worse", "undecided", "worse")
            lowest = own.iloc[int(own.final.argmin())]
            worst = (
                f"{_with_interval(lowest, 'final')}, {lowest.env}: {lowest.scenario}"
            )
            rows.append(
                [method, *(str((own.verdict == x).sum()) for x in words), worst]
            )
    head = ["method", "not worse", "undecided", "worse", "lowest final"]
    return "## Verdicts: scenarios by method\n\n" + _rows(head, rows)


def _kept(found: Found) -> str:
    """What line search keeps of boosting's gain, where there is one."""
    rows = []
    for (env, curriculum, method), own in found.items():
        boosted = found.get((env, curriculum, _PAIRS.get(method, "")))
        if boosted is None:
            continue
        plain = found[env, ONLY, "plain"]
        for name in ("final", "area"):
            values = (getattr(each, name) for each in (boosted, own, plain))
            kept = kept_gain(*values)
            if kept.verdict != "no gain":
                rows.append([env, curriculum, method, name, *_told(kept)])
    head = ["environment", "scenario", "method", "measure", "kept, %", "verdict"]
    title = "## Share of boosting's gain that line search keeps\n\n"
    return title + (_rows(head, rows) if rows else "Boosting gains nowhere.\n")


def _told(kept: Kept) -> list[str]:
    low, high = map(_percent, kept.interval)
    return [f"{_percent(kept.share)} [{low}, {high}]", kept.verdict]


def _environment(env: str, table: pd.DataFrame, scale: Scale) -> str:
    """Final and area, then jumpstart and time, of one environment."""
    own = table[table.env == env]
    parts = [f"## {env}\n\nr0 = {scale.first:.3g}, r1 = {scale.last:.3g}\n"]
    head = ["scenario", "method", "verdict", "final", "area", "jumpstart"]
    head += ["time", "reached"]
    rows = []
    for _, row in own.iterrows():
        told = [_with_interval(row, name) for name in ("final", "area", "jumpstart")]
        shares = [_percent(row.time), _percent(row.reached)]
        rows.append([row.scenario, row.method, row.verdict, *told, *shares])
    return "\n".join([*parts, _rows(head, rows)])


def _finals(found: Found, seeds: Sequence[int]) -> str:
    """CSV of the final return: a row per environment, scenario and seed."""
    columns = {key: pd.Series(own.final, list(seeds)) for key, own in found.items()}
    frame = pd.DataFrame(columns).rename_axis("seed")
    frame.columns = frame.columns.set_names(["env", "scenario", "method"])
    long = frame.stack(["env", "scenario"], future_stack=True)
    wide = long.reset_index().sort_values(["env", "scenario", "seed"], kind="stable")
    methods = [method for method in METHODS if method in wide]
    wide = wide[["env", "scenario", "seed", *methods]].dropna(subset=methods, how="all")
    text: str = wide.to_csv(index=False, float_format="%.6g", lineterminator="\n")
    return text
