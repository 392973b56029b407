"""One seed's three files, each read only if it is what the run recorded."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bcrl.common.files import is_intact, sha256
from bcrl.errors import BcrlError
from bcrl.results import layout

BROKEN, INCOMPLETE = "broken", "incomplete"  # kinds of findings
AGAIN = "run the same command again"

Document = dict[str, Any]  # a seed's JSON


@dataclass(frozen=True)
class Finding:
    """A file or folder that is not as a finished run leaves it, and what to do."""

    path: Path
    what: str
    remedy: str
    kind: str = BROKEN

    def __str__(self) -> str:
        name = str(self.path)
        shown = name if name.isprintable() else ascii(name)
        return f"{shown} {self.what}: {self.remedy}"


class BadFile(BcrlError):
    """A file that can't be read as what it should be; `finding` says why."""

    def __init__(self, finding: Finding) -> None:
        super().__init__(str(finding))
        self.finding = finding


def bad_file(path: Path, what: str, remedy: str = "") -> BadFile:
    """The error for a broken file; by default the remedy is to make the seed anew."""
    anew = f"delete {path.with_suffix('')}.* and {AGAIN} (it makes missing seeds only)"
    return BadFile(Finding(path, what, remedy or anew))


def read_document(folder: Path, seed: int) -> Document:
    """A seed's JSON; BadFile unless it is whole, unchanged and in its place."""
    path = layout.seed_path(folder, seed, "json")
    try:
        document = json.loads(_bytes(path))
        intact = isinstance(document, dict) and is_intact(document)
    except (ValueError, RecursionError) as error:
        raise bad_file(path, "is not readable JSON") from error
    if not isinstance(document, dict):
        raise bad_file(path, "is not a JSON object")
    if document.get("schema") != layout.SCHEMA:
        what = (
            f"has schema {document.get('schema')!r}, this version reads {layout.SCHEMA}"
        )
        raise bad_file(path, what)
    if not intact:
        raise bad_file(path, "was changed after it was written (see its digest)")
    for key, value in layout.belongs_to(folder, seed).items():
        if document.get(key) != value:
            what = f"belongs to {key} {document.get(key)!r}, not {value!r}"
            back = f"move it back, or delete {path.with_suffix('')}.* and {AGAIN}"
            raise bad_file(path, what, back)
    if not _has_the_schema(document):
        raise bad_file(path, f"lacks entries of schema {layout.SCHEMA}")
    return document


def _has_the_schema(document: Document) -> bool:
    """Whether the entries that are relied on are there."""
    try:
        layout.requested(document)
        metrics = document["config"]["env"]["metrics"]
        state, hashes = layout.state_of(document), document.get("sha256")
        # A seed that is running or failed may not have files yet.
        if state == layout.RUNNING or (state == layout.FAILED and hashes is None):
            return isinstance(metrics, list)
        hashed = {"csv", "npz"} <= (hashes or {}).keys()
        known = state in (layout.COMPLETE, layout.FAILED)
        return hashed and known and isinstance(metrics, list)
    except (KeyError, TypeError, AttributeError):
        return False


def command_of(document: Mapping[str, Any]) -> str:
    """The command that made a seed, ready to paste; empty if it isn't recorded."""
    return str(document.get("command") or "")


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise bad_file(path, "is missing") from error
    except OSError as error:
        what = f"can't be read ({error.strerror})"
        raise bad_file(path, what, "make it a readable file") from error


def read_recorded(path: Path, document: Document) -> bytes:
    """A CSV's or NPZ's bytes; BadFile unless the seed's JSON has their hash."""
    data = _bytes(path)
    if sha256(data) != document["sha256"][path.suffix[1:]]:
        raise bad_file(path, f"is not what {path.stem}.json has the SHA-256 of")
    return data


def read_csv(path: Path, document: Document) -> pd.DataFrame:
    """A complete seed's table, all columns numbers; BadFile if it isn't one."""
    data = read_recorded(path, document)
    try:
        table = pd.read_csv(io.BytesIO(data))
    except ValueError as error:
        raise bad_file(path, "is not a readable CSV") from error
    try:
        table = table.astype(float)
    except ValueError as error:
        raise bad_file(path, f"holds something not a number ({error})") from error
    family = layout.family_of(table)
    metrics: tuple[str, ...] = layout.DQN_METRICS
    known = metrics
    if family == "FQI":
        metrics = tuple(dict.fromkeys(document["config"]["env"]["metrics"]))
        known = layout.FQI_METRICS.get(document["env"], ())
    expected = [str(column) for column in (*layout.INDEX[family], *metrics)]
    if list(table.columns) != expected:
        found = ",".join(table.columns)
        raise bad_file(path, f"has the header {found}, expected {','.join(expected)}")
    if what := _disorder(table):
        raise bad_file(path, what)
    for name in known:
        if name in table and name not in layout.MAY_BE_NAN:
            bad = np.flatnonzero(~np.isfinite(table[name].to_numpy()))
            if len(bad):
                raise bad_file(path, f"has a non-finite {name} in row {bad[0] + 1}")
    return table


def _disorder(table: pd.DataFrame) -> str:
    """What is wrong with a table's index columns; empty if nothing is."""
    if table.empty:
        return "has no rows"
    if "iteration" in table:
        if not np.array_equal(table["iteration"], np.arange(1, len(table) + 1)):
            return f"does not count iterations 1 to {len(table)}"
    elif not _whole(table["step"], 0) or (np.diff(table["step"]) < 0).any():
        return "has steps that are not whole numbers ≥ 0 or fall"
    for column in ("stage", "task"):
        if not _whole(table[column], 1):
            return f"has a {column} that is not a whole number ≥ 1"
    return "has stages that fall" if (np.diff(table["stage"]) < 0).any() else ""


def _whole(values: pd.Series, least: int) -> bool:
    return bool((np.isfinite(values) & (values >= least) & (values % 1 == 0)).all())


def read_arrays(path: Path, *names: str) -> list[NDArray[Any]]:
    """The named arrays of an NPZ; BadFile if it does not hold them."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            return [stored[name] for name in names]
    except FileNotFoundError as error:
        raise bad_file(path, "is missing") from error
    except KeyError as error:
        what = f"does not hold what is needed ({error.args[0]})"
        raise bad_file(path, what) from error
    except (OSError, EOFError, ValueError, TypeError, zipfile.BadZipFile) as error:
        raise bad_file(path, "is not a readable NPZ") from error


def read_folder(folder: str | Path) -> pd.DataFrame:
    """The CSVs of all seeds in a variant's folder, unchecked, below a column `seed`.

    BcrlError if there are none.
    """
    numbers = layout.recorded_seeds(Path(folder), "csv")
    if not numbers:
        raise BcrlError(f"{folder}: there is no seed_*.csv")
    found = {n: pd.read_csv(layout.seed_path(Path(folder), n, "csv")) for n in numbers}
    together = pd.concat(found, names=["seed", None])
    return together.reset_index("seed").reset_index(drop=True)
