"""A seed's CSV as a table, checked, and those of a folder as they are."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bcrl.errors import BcrlError
from bcrl.results import layout
from bcrl.results.read import Document, Finding

#: Before pandas 3.1, numbers that are read are rounded unless it is told not to.
_OLD = [*map(int, pd.__version__.split(".")[:2])] < [3, 1]
_EXACT: dict[str, Any] = {"float_precision": "round_trip"} if _OLD else {}


def parsed(path: Path, data: bytes, document: Document) -> pd.DataFrame:
    """The table of a complete seed's CSV; Finding unless all its columns are sound."""
    try:
        table = pd.read_csv(io.BytesIO(data), dtype=float)
    except ValueError as error:
        raise Finding(path, f"is not a readable CSV of numbers ({error})") from error
    family = layout.family_of(table)
    metrics, finite = layout.DQN_METRICS, {*layout.DQN_METRICS} - {*layout.MAY_BE_NAN}
    if family == "FQI":
        metrics = tuple(dict.fromkeys(document["config"]["env"]["metrics"]))
        finite = {*layout.FQI_METRICS.get(document["env"], ())}
    alpha = document["config"].get("boosting", {}).get("alpha", 1.0)
    own = {*layout.SCALE} <= {*table.columns}  # a user's transfer may have changed it
    scale = layout.SCALE if alpha != 1.0 or own else ()
    expected = [str(column) for column in (*layout.INDEX[family], *metrics, *scale)]
    if list(table.columns) != expected:
        found = ",".join(table.columns)
        raise Finding(path, f"has the header {found}, expected {','.join(expected)}")
    if what := _disorder(table):
        raise Finding(path, what)
    checked = [name for name in expected if name in finite]
    for column, row in np.argwhere(~np.isfinite(table[checked].to_numpy(float).T)):
        raise Finding(path, f"has a non-finite {checked[column]} in row {row + 1}")
    return table


def _disorder(table: pd.DataFrame) -> str:
    """What is wrong with a table's index columns; empty if nothing is."""
    if table.empty:
        return "has no rows"
    for column, least in (("step", 0), ("iteration", 1), ("stage", 1), ("task", 1)):
        values = table.get(column, pd.Series([least]))
        if not ((values >= least) & (values % 1 == 0)).all():
            return f"has a {column} that is not a whole number ≥ {least}"
        if column != "task" and (np.diff(values) < 0).any():
            return f"has {column}s that fall"
    last = [0.0] if (table.stage == 1).any() else []  # else another run came before
    for stage, rows in table.groupby("stage") if "iteration" in table else ():
        steps = np.diff([*last, *rows.iteration])  # equal, the last may be shorter
        if (steps[:-1] != steps[:1]).any() or not (0 < steps[-1:] <= steps[:1]).all():
            return f"does not count stage {stage:.0f}'s iterations at one interval"
        last = [rows.iteration.iloc[-1]]
    return ""


def read_results(path: str | Path) -> pd.DataFrame:
    """A frame that `bcrl.api.run` saved, or all CSVs in a variant's folder, unchecked,
    with columns `method`, the folder's name, and `seed`. BcrlError if there is none."""
    path = Path(path)
    if path.is_file():
        return pd.read_csv(path, keep_default_na=False, na_values=[""], **_EXACT)
    numbers = layout.recorded_seeds(path, "csv")
    if not numbers:
        raise BcrlError(f"{path}: is no saved frame, and there is no seed_*.csv")
    found = {
        n: pd.read_csv(layout.seed_path(path, n, "csv"), **_EXACT) for n in numbers
    }
    table = pd.concat(found, names=["seed"]).reset_index("seed").reset_index(drop=True)
    table.insert(0, "method", path.resolve().name)
    return table
