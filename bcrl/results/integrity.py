"""Whether the variants' folders are what finished runs leave, and what is sound."""

import json
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import yaml

from bcrl.common.identity import differences, identity
from bcrl.results import layout, read
from bcrl.results.layout import requested, seed_path, state_of
from bcrl.results.read import AGAIN, INCOMPLETE, Document, Finding
from bcrl.results.tables import parsed

_SHOWN_KEYS = 3  # differing keys of a config that are named
_SUFFIXES = "|".join((*layout.SUFFIXES, layout.AGENT))
_NAME = re.compile(rf"{layout.SEED}([0-9]+)\.({_SUFFIXES})")


class Checked(NamedTuple):
    """A variant's folder: what is wrong, JSONs by seed, CSVs of the complete seeds."""

    folder: Path
    findings: list[Finding]
    documents: dict[int, Document]
    tables: dict[int, pd.DataFrame]
    requested: set[int]  # the seeds that were to be made so far


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
    findings: list[Finding] = []
    documents: dict[int, Document] = {}
    tables, numbers = {}, set()
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
            documents[seed] = document = read.read_document(folder, seed)
            complete = (state := state_of(document)) == layout.COMPLETE
            if complete or (state != layout.RUNNING and "sha256" in document):
                read.read_recorded(npz, document)
                if (agent := seed_path(folder, seed, layout.AGENT)).exists():
                    read.read_recorded(agent, document)
                data = read.read_recorded(csv, document)
                if complete:
                    tables[seed] = parsed(csv, data, document)
        except Finding as finding:
            findings.append(finding)
    findings += [*_config_findings(folder, documents), *_index_findings(folder, tables)]
    for seed, document in documents.items():
        if (state := state_of(document)) != layout.COMPLETE:
            path, what = seed_path(folder, seed, "json"), f'says "{document["status"]}"'
            wait = "wait if it is being computed, else " * (state == layout.RUNNING)
            findings.append(Finding(path, what, wait + _again([document]), INCOMPLETE))
    asked = set().union(*map(requested, documents.values()))
    if missing := sorted(asked - numbers):
        made = [d for d in documents.values() if missing[0] in requested(d)]
        what = f"lacks seeds {layout.spelled(missing)}, which a command was to make"
        findings.append(Finding(folder, what, _again(made), INCOMPLETE))
    if not numbers:
        findings.append(Finding(folder, "has no seeds", AGAIN, INCOMPLETE))
    return Checked(folder, findings, documents, tables, asked)


def _again(documents: list[Document]) -> str:
    """The advice to run the command again, with the first command that is recorded."""
    typed = next(filter(None, (d.get("command") for d in documents)), "")
    return f"{AGAIN} (`{typed}`)" if typed else AGAIN


def _config_findings(folder: Path, documents: dict[int, Document]) -> Iterator[Finding]:
    """Where config.yaml and the seeds' configs differ in what decides numbers."""
    path = folder / layout.CONFIG
    anew = f"put it back, or delete {folder} and {AGAIN}"
    configs = {seed_path(folder, s, "json"): d["config"] for s, d in documents.items()}
    try:
        configs[path] = yaml.safe_load(path.read_bytes())
        # As text, which tells 1 from 1.0 and from true.
        texts = {p: json.dumps(identity(c), sort_keys=True) for p, c in configs.items()}
    except Exception as error:  # PyYAML raises what its constructors happen to
        why = type(error).__name__
        what = f"is not a readable config ({why})" if path.exists() else "is missing"
        yield Finding(path, what, anew)
        return
    for each, model in _odd(texts):
        found = differences(configs[model], configs[each]).items()
        shown = [f"{key}: there {a!r}, here {b!r}" for key, (a, b) in found]
        changed = "; ".join(shown[:_SHOWN_KEYS]) or "types of values"
        what = f"has another config than {model.name} ({changed})"
        yield Finding(each, what, anew if each == path else "")


def _index_findings(folder: Path, tables: dict[int, pd.DataFrame]) -> Iterator[Finding]:
    """Seeds whose stages, tasks or counters are not those of most."""
    index = {
        seed_path(folder, seed, "csv"): table[[*layout.INDEX[layout.family_of(table)]]]
        for seed, table in tables.items()
    }
    keys = {p: (*t.columns, t.to_numpy().tobytes()) for p, t in index.items()}
    for path, model in _odd(keys):
        mine, theirs = index[path], index[model]
        names = [str(c) for c in theirs if list(mine.get(c, ())) != list(theirs[c])]
        sizes = f"{len(mine)} rows, not {len(theirs)}"
        where = ", ".join(names) if len(mine) == len(theirs) else sizes
        what = f"has another index than {model.name} ({where})"
        yield Finding(path, f"{what}: configurations or versions are mixed")


def _odd(keys: Mapping[Path, Any]) -> list[tuple[Path, Path]]:
    """The files that are not as most are, each with the first of those."""
    counts = Counter(keys.values())
    ranked = sorted(keys, key=lambda path: -counts[keys[path]])
    return [(path, ranked[0]) for path in keys if keys[path] != keys[ranked[0]]]
