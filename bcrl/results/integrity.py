"""Whether the variants' folders are what finished runs leave, and what is sound."""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from bcrl.common.identity import differences, identity
from bcrl.results import layout
from bcrl.results.layout import requested, seed_path, state_of
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
_NAME = re.compile(rf"{layout.SEED}([0-9]+)\.({'|'.join(layout.SUFFIXES)})")
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
    folders = [runs_dir / scale] if scale else _entries(runs_dir, findings)
    for _ in ("environments", "variants"):
        folders = [path for folder in folders for path in _entries(folder, findings)]
    variants = [check_folder(folder) for folder in folders if folder.is_dir()]
    findings += [finding for variant in variants for finding in variant.findings]
    return variants, sorted(findings, key=lambda finding: finding.kind == INCOMPLETE)


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
    result, numbers = Checked(folder), set()
    findings, documents = result.findings, Documents()
    for path in _entries(folder, findings):
        match = _NAME.fullmatch(path.name)
        if match and path == seed_path(folder, int(match[1]), match[2]):
            numbers.add(int(match[1]))
        elif path.name.startswith(layout.SEED):
            what = "is not a name that bcrl gives"
            findings.append(Finding(path, what, "move it out of the folder"))
    for seed in sorted(numbers):
        csv, npz = (seed_path(folder, seed, suffix) for suffix in ("csv", "npz"))
        try:
            documents[seed] = document = read_document(folder, seed)
            state = state_of(document)
            if state != layout.RUNNING and "sha256" in document:
                read_recorded(npz, document)
                read_recorded(csv, document)
            if state == layout.COMPLETE:
                result.tables[seed] = read_csv(csv, document)
                result.documents[seed] = document
            if state == layout.FAILED:
                result.failed += (seed,)
        except BadFile as error:
            findings.append(error.finding)
    result.requested = frozenset().union(*map(requested, documents.values()))
    findings += _config_findings(folder, documents)
    findings += _index_findings(folder, result.tables)
    findings += _unfinished(folder, documents)
    if missing := sorted(result.requested - numbers):
        made = (d for d in documents.values() if missing[0] in requested(d))
        typed = next(filter(None, map(command_of, made)), "")
        what = f"lacks seed{'s' * (len(missing) > 1)} {layout.spelled(missing)}"
        remedy = AGAIN + (f" (`{typed}`)" if typed else "")
        what += ", which a command was to make"
        findings.append(Finding(folder, what, remedy, INCOMPLETE))
    if not numbers:
        remedy = f"{AGAIN}, or move the folder away"
        findings.append(Finding(folder, "has no seeds", remedy, INCOMPLETE))
    return result


def _unfinished(folder: Path, documents: Documents) -> Iterator[Finding]:
    """Seeds that were begun or have failed."""
    for seed, document in documents.items():
        path = seed_path(folder, seed, "json")
        if state_of(document) == layout.RUNNING:
            what = 'says "running": it is being computed, or its process was killed'
            yield Finding(path, what, AGAIN, INCOMPLETE)
        if state_of(document) == layout.FAILED:
            remedy = f"{AGAIN} to try it again, or leave it out"
            yield Finding(path, f'says "{document["status"]}"', remedy, INCOMPLETE)


def _config_findings(folder: Path, documents: Documents) -> list[Finding]:
    """Where config.yaml and the seeds' configs differ in what decides numbers."""
    path = folder / layout.CONFIG
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
    changed = {seed: _changed(config, made[seed]) for seed in odd}
    if odd and len(odd) == len(made) and len(set(odd.values())) == 1:
        what = f"is not its seeds' config ({changed[min(odd)]})"
        return [Finding(path, what, anew)]
    other = f"has another config than {layout.CONFIG}"
    return [_odd(folder, seed, "json", f"{other} ({changed[seed]})") for seed in odd]


def _text(config: dict[str, Any]) -> str:
    """A config's identity as text, which tells 1 from 1.0 and from true."""
    return json.dumps(identity(config), sort_keys=True)


def _changed(config: dict[str, Any], made: dict[str, Any]) -> str:
    """The first keys in which config.yaml differs from what a seed was made with."""
    changed = list(differences(config, made).items())
    shown = [f"{k}: there {a!r}, here {b!r}" for k, (a, b) in changed[:SHOWN_KEYS]]
    more = len(changed) - len(shown)
    return "; ".join(shown + [f"and {more} more"] * (more > 0)) or "types of values"


def _odd(folder: Path, seed: int, suffix: str, what: str) -> Finding:
    """A seed that is not of the same origin as the others in its folder."""
    remedy = f"delete {seed_path(folder, seed, '*')} and {AGAIN}"
    return Finding(seed_path(folder, seed, suffix), what, remedy)


def _index_findings(folder: Path, tables: dict[int, pd.DataFrame]) -> Iterator[Finding]:
    """Seeds whose stages, tasks or counters are not those of most."""
    columns = {s: layout.INDEX[layout.family_of(t)] for s, t in tables.items()}
    keys = {
        s: (columns[s], t[[*columns[s]]].to_numpy().tobytes())
        for s, t in tables.items()
    }
    usual = Counter(keys.values()).most_common(1)
    odd = [seed for seed in keys if keys[seed] != usual[0][0]]
    for seed in odd:
        model = next(other for other in keys if keys[other] == usual[0][0])
        mine, theirs = tables[seed], tables[model]
        names = [c for c in columns[model] if list(mine.get(c, ())) != list(theirs[c])]
        where = f"{' and '.join(names)} column{'s' * (len(names) > 1)}"
        if len(mine) != len(theirs):
            where = f"length ({len(mine)} rows, not {len(theirs)})"
        what = f"differs from {seed_path(folder, model, 'csv').name} in its {where}"
        mixed = ", so the folder mixes two configurations or versions"
        yield _odd(folder, seed, "csv", what + mixed)
