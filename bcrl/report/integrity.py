"""Whether a variant's folder is what a finished run leaves, and what of it is sound."""

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

from bcrl.common.files import seed_path
from bcrl.common.identity import differences, identity
from bcrl.report.findings import AGAIN, INCOMPLETE, Finding, Refused
from bcrl.report.notes import listed, ranges
from bcrl.report.seedfiles import (
    INDEX,
    asked,
    command,
    family_of,
    read_csv,
    read_document,
    recorded,
    status,
)

SHOWN_KEYS = 3  # differing keys of a config that are named
Documents = dict[int, dict[str, Any]]  # by seed


@dataclass
class Checked:
    """A variant's folder: the findings in it, and its complete seeds that are sound.

    `tables` and `documents` are the CSVs and JSONs of these; `failed` are the seeds
    that diverged, `asked` all that were asked for.
    """

    folder: Path
    findings: list[Finding] = field(default_factory=list)
    documents: Documents = field(default_factory=dict)
    tables: dict[int, pd.DataFrame] = field(default_factory=dict)
    failed: tuple[int, ...] = ()
    asked: frozenset[int] = frozenset()


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
    """The folders in a folder, unless hidden."""
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
    documents = _documents(folder, numbers, findings)
    findings += _config_findings(folder, documents)
    for seed, document in documents.items():
        csv, npz = (seed_path(folder, seed, suffix) for suffix in ("csv", "npz"))
        state = status(document)
        try:
            if state != "running" and "sha256" in document:
                recorded(npz, document)
                recorded(csv, document)
            if state == "complete":
                table = read_csv(csv, document)
                result.tables[seed], result.documents[seed] = table, document
        except Refused as error:
            findings.append(error.finding)
    findings += _index_findings(folder, result.tables)
    findings += _incomplete_findings(folder, numbers, documents)
    result.failed = tuple(s for s, d in documents.items() if status(d) == "failed")
    result.asked = frozenset().union(*map(asked, documents.values()))
    return result


def _numbers(folder: Path, findings: list[Finding]) -> set[int]:
    """The seeds that any file is named after; misnamed files are findings."""
    numbers = set()
    for path in _entries(folder, findings):
        match = re.fullmatch(r"seed_([0-9]+)\.(csv|npz|json)", path.name)
        if match and path == seed_path(folder, int(match[1]), match[2]):
            numbers.add(int(match[1]))
        elif path.name.startswith("seed_"):
            what = "is not a name that bcrl gives"
            findings.append(Finding(path, what, "move it out of the folder"))
    return numbers


def _documents(
    folder: Path, numbers: Iterable[int], findings: list[Finding]
) -> Documents:
    """The seeds' JSONs that can be trusted; the others are findings."""
    *_, scale, env, name = folder.parts
    variant, _, tag = name.partition("@")
    belongs = {"scale": scale, "env": env, "variant": variant, "tag": tag or None}
    documents = {}
    for seed in sorted(numbers):
        path = seed_path(folder, seed, "json")
        try:
            documents[seed] = read_document(path, {"seed": seed} | belongs)
        except Refused as error:
            findings.append(error.finding)
    return documents


def _config_findings(folder: Path, documents: Documents) -> list[Finding]:
    """Where config.yaml and the seeds' configs differ in what decides numbers."""
    path = folder / "config.yaml"
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
    texts = {seed: _text(each) for seed, each in made.items()}
    odd = [seed for seed in made if texts[seed] != text]
    if odd and len(odd) == len(made) and len(set(texts.values())) == 1:
        what = f"is not its seeds' config ({_changed(config, made[odd[0]])})"
        return [Finding(path, what, anew)]
    return [
        Finding(
            seed_path(folder, seed, "json"),
            f"has another config than config.yaml ({_changed(config, made[seed])})",
            f"delete {seed_path(folder, seed, '*')} and {AGAIN}",
        )
        for seed in odd
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


def _index_findings(folder: Path, tables: Mapping[int, pd.DataFrame]) -> list[Finding]:
    """Seeds whose stages, tasks or counters are not those of most."""
    indices = {
        seed: table[list(INDEX[family_of(table)])] for seed, table in tables.items()
    }
    keys = {s: (*i.columns, i.to_numpy().tobytes()) for s, i in indices.items()}
    (usual, _), *others = Counter(keys.values()).most_common() or [(None, 0)]
    if not others:
        return []
    model = next(seed for seed in keys if keys[seed] == usual)
    return [
        Finding(
            seed_path(folder, seed, "csv"),
            f"differs from {seed_path(folder, model, 'csv').name} in its "
            f"{_columns(indices[seed], indices[model])}, so the folder mixes two "
            "configurations or versions",
            f"delete {seed_path(folder, seed, '*')} and {AGAIN}",
        )
        for seed in keys
        if keys[seed] != usual
    ]


def _columns(index: pd.DataFrame, model: pd.DataFrame) -> str:
    if len(index) != len(model):
        return f"length ({len(index)} rows, not {len(model)})"
    differ = [name for name in model if not model[name].equals(index.get(name))]
    return f"{listed(differ)} column{'s' * (len(differ) > 1)}"


def _incomplete_findings(
    folder: Path, numbers: set[int], documents: Documents
) -> Iterator[Finding]:
    """Seeds that are not complete: begun, failed, or not there though asked for."""
    for seed, document in documents.items():
        path = seed_path(folder, seed, "json")
        if status(document) == "running":
            what = 'says "running": it is being computed, or its process was killed'
            yield Finding(path, what, AGAIN, INCOMPLETE)
        if status(document) == "failed":
            what = f'says "{document["status"]}"'
            remedy = f"{AGAIN} to try it again, or leave it out"
            yield Finding(path, what, remedy, INCOMPLETE)
    missing = sorted(set().union(*map(asked, documents.values())) - numbers)
    if missing:
        noun = "seed" if len(missing) == 1 else "seeds"
        what = f"lacks {noun} {ranges(missing)}, which had been asked for"
        remedy = _command(documents.values(), missing[0])
        yield Finding(folder, what, remedy, INCOMPLETE)
    if not numbers:
        remedy = f"{AGAIN}, or move the folder away"
        yield Finding(folder, "has no seeds", remedy, INCOMPLETE)


def _command(documents: Iterable[dict[str, Any]], seed: int) -> str:
    """What to do about a missing seed: the command that asked for it, if known."""
    commands = (command(d) for d in documents if seed in asked(d))
    found = next(filter(None, commands), None)
    return f"{AGAIN} (`{found}`)" if found else AGAIN
