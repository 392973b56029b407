"""Whether the variants' folders are what finished runs leave, and what is sound."""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from bcrl.common.identity import differences, identity
from bcrl.results.layout import (
    COMPLETE,
    CONFIG,
    FAILED,
    INDEX,
    RUNNING,
    SEED,
    SUFFIXES,
    family_of,
    requested,
    seed_path,
    spelled,
    state_of,
)
from bcrl.results.read import (
    AGAIN,
    INCOMPLETE,
    BadFile,
    Document,
    Finding,
    command_of,
    read_csv,
    read_document,
    read_recorded,
)

SHOWN_KEYS = 3  # differing keys of a config that are named
Documents = dict[int, Document]  # by seed


@dataclass
class Checked:
    """A variant's folder: the findings in it, and its complete seeds that are sound.

    `tables` and `documents` are the CSVs and JSONs of these; `failed` are the seeds
    that diverged, `requested` all that the commands so far were to make.
    """

    folder: Path
    findings: list[Finding] = field(default_factory=list)
    documents: Documents = field(default_factory=dict)
    tables: dict[int, pd.DataFrame] = field(default_factory=dict)
    failed: tuple[int, ...] = ()
    requested: frozenset[int] = frozenset()


def check_tree(
    runs_dir: Path, scale: str | None = None
) -> tuple[list[Checked], list[Finding]]:
    """All variants' folders of a scale, or of all, and all findings, broken first."""
    findings: list[Finding] = []
    scales = [runs_dir / scale] if scale else _subfolders(runs_dir, findings)
    environments = [env for path in scales for env in _subfolders(path, findings)]
    folders = [path for env in environments for path in _subfolders(env, findings)]
    variants = [check_folder(folder) for folder in folders]
    findings += [finding for variant in variants for finding in variant.findings]
    return variants, sorted(findings, key=lambda finding: finding.kind == INCOMPLETE)


def _subfolders(folder: Path, findings: list[Finding]) -> list[Path]:
    return [path for path in _entries(folder, findings) if path.is_dir()]


def _entries(folder: Path, findings: list[Finding]) -> list[Path]:
    """What is in a folder, unless hidden; one that can't be read is a finding."""
    try:
        if not folder.is_dir():
            return []
        entries = sorted(folder.iterdir())
        os.stat(f"{folder}/.")  # to enter needs another permission than to list
    except OSError as error:
        what = f"can't be read ({error.strerror})"
        findings.append(Finding(folder, what, "make it readable"))
        return []
    return [path for path in entries if not path.name.startswith(".")]


def check_folder(folder: Path) -> Checked:
    """Every file of `<runs_dir>/<scale>/<env>/<variant>[@tag]`, checked."""
    result = Checked(folder)
    findings = result.findings
    numbers = _numbers(folder, findings)
    documents: Documents = {}
    for seed in sorted(numbers):
        try:
            documents[seed] = read_document(folder, seed)
        except BadFile as error:
            findings.append(error.finding)
    findings += _config_findings(folder, documents)
    for seed, document in documents.items():
        csv, npz = (seed_path(folder, seed, suffix) for suffix in ("csv", "npz"))
        state = state_of(document)
        try:
            if state != RUNNING and "sha256" in document:
                read_recorded(npz, document)
                read_recorded(csv, document)
            if state == COMPLETE:
                table = read_csv(csv, document)
                result.tables[seed], result.documents[seed] = table, document
        except BadFile as error:
            findings.append(error.finding)
    findings += _index_findings(folder, result.tables)
    result.failed = tuple(s for s, d in documents.items() if state_of(d) == FAILED)
    result.requested = frozenset().union(*map(requested, documents.values()))
    findings += _incomplete_findings(folder, numbers, documents, result.requested)
    return result


def _numbers(folder: Path, findings: list[Finding]) -> set[int]:
    """The seeds that any file is named after; misnamed files are findings."""
    numbers = set()
    for path in _entries(folder, findings):
        match = re.fullmatch(rf"{SEED}([0-9]+)\.({'|'.join(SUFFIXES)})", path.name)
        if match and path == seed_path(folder, int(match[1]), match[2]):
            numbers.add(int(match[1]))
        elif path.name.startswith(SEED):
            what = "is not a name that bcrl gives"
            findings.append(Finding(path, what, "move it out of the folder"))
    return numbers


def _config_findings(folder: Path, documents: Documents) -> list[Finding]:
    """Where config.yaml and the seeds' configs differ in what decides numbers."""
    path = folder / CONFIG
    anew = f"put it back, or delete {folder} and {AGAIN}"
    try:
        config = yaml.safe_load(path.read_bytes())
        text = _text(config)
    except FileNotFoundError:
        return [Finding(path, "is missing", anew)]
    except Exception as error:  # PyYAML raises what its constructors happen to
        what = f"is not a readable config ({type(error).__name__})"
        return [Finding(path, what, anew)]
    made = {seed: document["config"] for seed, document in documents.items()}
    odd = {seed: _text(each) for seed, each in made.items() if _text(each) != text}
    if odd and len(odd) == len(made) and len(set(odd.values())) == 1:
        what = f"is not its seeds' config ({_changed(config, made[min(odd)])})"
        return [Finding(path, what, anew)]
    return [
        _mixed(folder, seed, "json", f"has another config than {CONFIG} ({changed})")
        for seed in odd
        for changed in [_changed(config, made[seed])]
    ]


def _text(config: dict[str, Any]) -> str:
    """A config's identity as text, which tells 1 from 1.0 and from true."""
    return json.dumps(identity(config), sort_keys=True)


def _changed(config: dict[str, Any], made: dict[str, Any]) -> str:
    """The first keys in which config.yaml differs from what a seed was made with."""
    changed = list(differences(config, made).items())
    shown = [f"{k}: there {a!r}, here {b!r}" for k, (a, b) in changed[:SHOWN_KEYS]]
    more = len(changed) - len(shown)
    return "; ".join(shown + [f"and {more} more"] * (more > 0)) or "types of values"


def _mixed(folder: Path, seed: int, suffix: str, what: str) -> Finding:
    """A seed that is not of the same origin as the others in its folder."""
    remedy = f"delete {seed_path(folder, seed, '*')} and {AGAIN}"
    return Finding(seed_path(folder, seed, suffix), what, remedy)


def _index_findings(
    folder: Path, tables: Mapping[int, pd.DataFrame]
) -> Iterator[Finding]:
    """Seeds whose stages, tasks or counters are not those of most."""
    indices = {seed: t[list(INDEX[family_of(t)])] for seed, t in tables.items()}
    keys = {s: (*i.columns, i.to_numpy().tobytes()) for s, i in indices.items()}
    for usual, _ in Counter(keys.values()).most_common(1):
        model = next(seed for seed in keys if keys[seed] == usual)
        for seed in keys:
            if keys[seed] != usual:
                where = _differing(indices[seed], indices[model])
                yield _mixed(
                    *(folder, seed, "csv"),
                    f"differs from {seed_path(folder, model, 'csv').name} in its "
                    f"{where}, so the folder mixes two configurations or versions",
                )


def _differing(index: pd.DataFrame, model: pd.DataFrame) -> str:
    if len(index) != len(model):
        return f"length ({len(index)} rows, not {len(model)})"
    differ = [str(c) for c in model if list(model[c]) != list(index.get(c, []))]
    return f"{' and '.join(differ)} column{'s' * (len(differ) > 1)}"


def _incomplete_findings(
    folder: Path, numbers: set[int], documents: Documents, wanted: Iterable[int]
) -> Iterator[Finding]:
    """Seeds that are not complete: begun, failed, or requested and absent."""
    for seed, document in documents.items():
        path, state = seed_path(folder, seed, "json"), state_of(document)
        if state == RUNNING:
            what = 'says "running": it is being computed, or its process was killed'
            yield Finding(path, what, AGAIN, INCOMPLETE)
        if state == FAILED:
            what = f'says "{document["status"]}"'
            remedy = f"{AGAIN} to try it again, or leave it out"
            yield Finding(path, what, remedy, INCOMPLETE)
    missing = sorted(set(wanted) - numbers)
    if missing:
        made = (d for d in documents.values() if missing[0] in requested(d))
        typed = next(filter(None, map(command_of, made)), "")
        noun = "seed" if len(missing) == 1 else "seeds"
        what = f"lacks {noun} {spelled(missing)}, which a command was to make"
        yield Finding(
            folder, what, AGAIN + (f" (`{typed}`)" if typed else ""), INCOMPLETE
        )
    if not numbers:
        remedy = f"{AGAIN}, or move the folder away"
        yield Finding(folder, "has no seeds", remedy, INCOMPLETE)
