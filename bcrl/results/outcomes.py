"""What a complete seed ends with: its return and its share of solved episodes."""

import csv
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bcrl.results import layout
from bcrl.results.read import read_document, read_recorded
from bcrl.results.tasks import target_of

WINDOW = 5000  # environment steps before the target's end with averaged evaluations


class Outcome(NamedTuple):
    """A seed's outcome, nan where it is not recorded."""

    returned: float
    success: float
    cpu_seconds: float


def late_rows(target_rows: NDArray[np.intp], index: NDArray) -> NDArray[np.intp]:
    """Those of the target's rows that are in its last WINDOW steps, which are also the
    run's last ones unless its curriculum ends with another task, (L,)."""
    steps = index[target_rows]
    return target_rows[steps > steps[-1] - WINDOW]


def outcome(folder: Path, seed: int) -> Outcome | None:
    """What a seed ended with in the target: after fitted Q-iteration (FQI) at the last
    evaluation, in the DQN family on average over `late_rows`. None for a seed that is
    not complete; Finding if its files are not what the run recorded."""
    document = read_document(folder, seed)
    if layout.state_of(document) != layout.COMPLETE:
        return None
    data = read_recorded(layout.seed_path(folder, seed, "csv"), document)
    header, *rows = csv.reader(data.decode().splitlines())
    table = np.array([[float(x or "nan") for x in row] for row in rows])
    columns = dict(zip(header, table.T, strict=True))
    task = columns["task"]
    chosen = np.flatnonzero(task == target_of(document["config"], task))
    if layout.family_of(columns) == "FQI":
        chosen, success = chosen[-1:], "solved"
    else:
        chosen, success = late_rows(chosen, columns["step"]), "success_rate"
    nothing = np.full(len(table), math.nan)
    ends = [columns.get(x, nothing)[chosen].mean() for x in ("return", success)]
    cpu = float(document.get("cpu_seconds") or 0.0)
    return Outcome(float(ends[0]), float(ends[1]), cpu)
