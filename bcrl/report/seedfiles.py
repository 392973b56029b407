"""One seed's three files, read with an eye to what may be wrong with them."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bcrl.errors import BcrlError

#: The first columns of a family's CSVs: 1-based stage and task, then what counts the
#: rows: iterations over the whole run, or environment steps of all stages so far.
INDEX = {"FQI": ("stage", "task", "iteration"), "DQN": ("stage", "task", "step")}


def family_of(table: pd.DataFrame) -> str:
    """The family whose learners leave such a table, told by its counting column."""
    return "DQN" if "step" in table and "iteration" not in table else "FQI"


def unreadable(path: Path, what: str) -> BcrlError:
    """The error for a broken file of a complete seed: what is wrong, what mends it."""
    stem = path.with_suffix("")
    return BcrlError(
        f"{path} {what}: delete {stem}.* and rerun that seed "
        "(`bcrl` makes missing seeds only)"
    )


def read_sidecar(path: Path, seed: int) -> dict[str, Any]:
    """A seed's JSON document; BcrlError if it is none or another seed's."""
    try:
        sidecar = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise unreadable(path, "is not readable JSON") from error
    if not isinstance(sidecar, dict):
        raise unreadable(path, "is not a JSON object")
    if sidecar.get("seed", seed) != seed:
        raise unreadable(path, f"belongs to seed {sidecar['seed']}")
    return sidecar


def read_csv(path: Path) -> pd.DataFrame:
    """A seed's table, all columns numbers; BcrlError if it is not such a table."""
    try:
        table = pd.read_csv(path)
    except FileNotFoundError as error:
        raise unreadable(path, "is missing") from error
    except (OSError, ValueError, pd.errors.ParserError) as error:
        raise unreadable(path, "is not a readable CSV") from error
    try:
        table = table.astype(float)
    except ValueError as error:
        raise unreadable(path, f"holds something not a number ({error})") from error
    if table.empty:
        raise unreadable(path, "has no rows")
    if "iteration" in table:
        expected = np.arange(1, len(table) + 1)
        if not np.array_equal(table["iteration"], expected):
            raise unreadable(path, f"does not count iterations 1 to {len(table)}")
    elif "step" in table:
        steps = table["step"]
        whole = np.isfinite(steps) & (steps >= 0) & (steps % 1 == 0)
        if not whole.all() or (np.diff(steps) < 0).any():
            raise unreadable(path, "has steps that are not whole numbers ≥ 0 or fall")
    for column in {"stage", "task"} & set(table):
        numbers = table[column]
        if not (np.isfinite(numbers) & (numbers >= 1) & (numbers % 1 == 0)).all():
            raise unreadable(path, f"has a {column} that is not a whole number ≥ 1")
    return table


def read_arrays(path: Path, *names: str) -> list[NDArray[np.float64]]:
    """The named arrays of an NPZ; BcrlError if it does not hold them."""
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
