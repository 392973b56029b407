"""One seed's three files, each read only if it is what was recorded."""

from __future__ import annotations

import io
import json
import shlex
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bcrl.common.files import is_intact, sha256
from bcrl.report.findings import AGAIN, unreadable

SCHEMA = 2  # of the records that this report reads

#: The first columns of a family's CSVs: 1-based stage and task, then what counts the
#: rows: iterations over the whole run, or environment steps of all stages so far.
INDEX = {"FQI": ("stage", "task", "iteration"), "DQN": ("stage", "task", "step")}

#: What FQI's CSVs hold after the index columns where figures are drawn of them; other
#: environments' may hold anything.
METRICS = {
    "car_on_hill": ("q_error", "return"),
    "maze": ("return", "q_error_start", "q_error", "residual_start", "solved"),
}

#: What the DQN family's CSVs hold after the index columns, in every environment.
DQN_METRICS = (
    *("return", "discounted_return", "success_rate", "q_mean", "loss"),
    *("greedy_return", "greedy_discounted_return", "greedy_success_rate"),
)
#: Columns of these that are nan wherever there was nothing to average.
MAY_BE_NAN = ("q_mean", "loss")


def family_of(table: pd.DataFrame) -> str:
    """The family whose learners leave such a table, told by its counting column."""
    return "DQN" if "step" in table and "iteration" not in table else "FQI"


def read_document(path: Path, belongs: Mapping[str, object]) -> dict[str, Any]:
    """A seed's JSON document; Refused unless it is whole, unchanged and in its place.

    `belongs`: the seed, scale, env, variant and tag that its path speaks of.
    """
    try:
        document = json.loads(_bytes(path))
        intact = isinstance(document, dict) and is_intact(document)
    except (ValueError, RecursionError) as error:
        raise unreadable(path, "is not readable JSON") from error
    if not isinstance(document, dict):
        raise unreadable(path, "is not a JSON object")
    if document.get("schema") != SCHEMA:
        what = f"has schema {document.get('schema')!r}, this version reads {SCHEMA}"
        raise unreadable(path, what)
    if not intact:
        raise unreadable(path, "was changed after it was written (see its digest)")
    for key, value in belongs.items():
        if document.get(key) != value:
            what = f"belongs to {key} {document.get(key)!r}, not {value!r}"
            back = f"move it back, or delete {path.with_suffix('')}.* and {AGAIN}"
            raise unreadable(path, what, back)
    if not _has_the_schema(document):
        raise unreadable(path, f"lacks entries of schema {SCHEMA}")
    return document


def _has_the_schema(document: dict[str, Any]) -> bool:
    """Whether the entries that are relied on are there."""
    try:
        asked(document)
        settled = isinstance(document["config"]["env"]["metrics"], list)
        state = status(document)
        # A seed that failed may have done so before it had files.
        needed = state == "complete" or (state == "failed" and "sha256" in document)
        hashed = not needed or {"csv", "npz"} <= document["sha256"].keys()
    except (KeyError, TypeError, AttributeError):
        return False
    return settled and hashed and state in ("running", "complete", "failed")


def status(document: Mapping[str, Any]) -> str:
    """`running`, `complete` or `failed`, without the reason."""
    return document["status"].partition(":")[0]


def asked(document: Mapping[str, Any]) -> set[int]:
    """The seeds that were asked for when this one was made."""
    return {seed for a, b in document["asked"] for seed in range(a, b + 1)}


def command(document: Mapping[str, Any]) -> str:
    """The command that made a seed, to be pasted; empty if it isn't recorded.

    Older records are not quoted: their words are what spaces separate.
    """
    recorded = str(document.get("command") or "")
    try:
        words = shlex.split(recorded)
    except ValueError:  # an older one with a single quote
        words = recorded.split(" ")
    return shlex.join([Path(word).name for word in words[:1]] + words[1:])


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise unreadable(path, "is missing") from error
    except OSError as error:
        what = f"can't be read ({error.strerror})"
        raise unreadable(path, what, "make it a readable file") from error


def recorded(path: Path, document: Mapping[str, Any]) -> bytes:
    """A file's bytes; Refused unless their hash is the one in the seed's JSON."""
    data = _bytes(path)
    if sha256(data) != document["sha256"][path.suffix[1:]]:
        raise unreadable(path, f"is not what {path.stem}.json has the SHA-256 of")
    return data


def read_csv(path: Path, document: Mapping[str, Any]) -> pd.DataFrame:
    """A complete seed's table, all columns numbers; Refused if it is not such a one."""
    data = recorded(path, document)
    try:
        table = pd.read_csv(io.BytesIO(data))
    except ValueError as error:
        raise unreadable(path, "is not a readable CSV") from error
    try:
        table = table.astype(float)
    except ValueError as error:
        raise unreadable(path, f"holds something not a number ({error})") from error
    family = family_of(table)
    metrics = DQN_METRICS
    if family == "FQI":
        metrics = tuple(dict.fromkeys(document["config"]["env"]["metrics"]))
    if tuple(table.columns) != (*INDEX[family], *metrics):
        expected = ",".join(map(str, (*INDEX[family], *metrics)))
        what = f"has the header {','.join(table.columns)}, expected {expected}"
        raise unreadable(path, what)
    if table.empty:
        raise unreadable(path, "has no rows")
    _check_index(path, table)
    known = METRICS.get(document["env"], ()) if family == "FQI" else DQN_METRICS
    for name in known:
        if name not in table or name in MAY_BE_NAN:
            continue
        bad = np.flatnonzero(~np.isfinite(table[name].to_numpy()))
        if len(bad):
            raise unreadable(path, f"has a non-finite {name} in row {bad[0] + 1}")
    return table


def _check_index(path: Path, table: pd.DataFrame) -> None:
    """Refused unless the rows are numbered and in order."""
    if "iteration" in table:
        expected = np.arange(1, len(table) + 1)
        if not np.array_equal(table["iteration"], expected):
            raise unreadable(path, f"does not count iterations 1 to {len(table)}")
    else:
        steps = table["step"].to_numpy()
        whole = np.isfinite(steps) & (steps >= 0) & (steps % 1 == 0)
        if not whole.all() or (np.diff(steps) < 0).any():
            raise unreadable(path, "has steps that are not whole numbers ≥ 0 or fall")
    for column in ("stage", "task"):
        numbers = table[column].to_numpy()
        if not (np.isfinite(numbers) & (numbers >= 1) & (numbers % 1 == 0)).all():
            raise unreadable(path, f"has a {column} that is not a whole number ≥ 1")
    if (np.diff(table["stage"]) < 0).any():
        raise unreadable(path, "has stages that fall")


def read_arrays(path: Path, *names: str) -> list[NDArray[np.float64]]:
    """The named arrays of an NPZ; Refused if it does not hold them."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            return [stored[name] for name in names]
    except FileNotFoundError as error:
        raise unreadable(path, "is missing") from error
    except KeyError as error:
        raise unreadable(path, f"does not hold what is needed ({error.args[0]})") from (
            error
        )
    except (OSError, EOFError, ValueError, TypeError, zipfile.BadZipFile) as error:
        raise unreadable(path, "is not a readable NPZ") from error
