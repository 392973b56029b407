"""Small choices of whole runs, how to run them, and how to compare their folders."""

import json
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from bcrl.common import files
from bcrl.config.plan import Plan
from bcrl.results import loggers
from bcrl.results.layout import seed_path
from bcrl.run import runner
from tests.conftest import plan

FQI = ("scale=smoke", "progress=none", "seeds.count=2")
MAZE = ("env=maze", "variant=BC", *FQI)
TABULAR = ("env=maze", *FQI, "algorithm/regressor=tabular")
LINEAR = ("env=linear_system", "algorithm=dqn", "scale=smoke", "progress=none")
#: DQN in a second: 40 updates after the random steps, with several target copies.
DQN = (*LINEAR, "seeds.count=2", "scale.max_steps=540", "algorithm.target_update=7")
DQN += ("algorithm.evaluation_episodes=3", "tag=x")
METHODS = ("plain", "C", "B", "BC", "SC", "SBC", "RPL", "PPR")
METHODS += ("BC_released", "SC_released", "SBC_released")
METHODS += ("B_line_search", "BC_line_search", "SBC_line_search")
HILL = ("env=car_on_hill", *FQI, "tag=x")
SHORT = (*HILL, "env.horizon=20")
LQ = ("env.tasks.task=[lq]", "env.tasks.horizon=[100]", "algorithm.steps=400")
SMALL = tuple(word for word in DQN if word != "env=linear_system")
CART = ("env.horizon=90", "scale.max_steps=150", "algorithm.learning_starts=60")
#: Every variant of the paper, and others; RPL's offset is shorter than the run.
KINDS = {
    f"{env} {name}": (f"env={env}", f"variant={name}", *FQI)
    for env in ("car_on_hill", "maze")
    for name in ("plain", "C", "B", "BC", "SC", "SBC", "SBC_line_search")
}
KINDS |= {f"dqn {name}": (*DQN, f"variant={name}") for name in METHODS}
KINDS["dqn RPL"] += ("transfer.offset=510",)
KINDS |= {
    "dqn in the maze": ("env=maze", *SMALL, "variant=SBC", "scale.max_steps=100"),
    "dqn on the hill": ("env=car_on_hill", *SMALL, "variant=PPR"),
    "dqn in gymnasium": ("env=cart_pole", *SMALL, "variant=SBC", *CART),
    "lspi": (*DQN, *LQ, "algorithm.learners=lspi"),
    "tables": (*TABULAR, "variant=BC"),
    "fqi on the system": ("env=linear_system", "variant=BC", *FQI),
    "fqi in gymnasium": ("env=acrobot", "variant=BC", *FQI, "env.horizon=15"),
    "sklearn's forest": (*SHORT, "variant=BC", "algorithm/regressor=sklearn_forest"),
    "sklearn by name": (*SHORT, "variant=C", "algorithm/regressor=sklearn"),
    "the same data": (*HILL, "variant=B", "algorithm.dataset=shared"),
}
KINDS["the same data"] += ("algorithm.new_data=task",)
KINDS |= {
    "folded tables": (*MAZE, "boosting.fold=2"),
    "folded forests": (*SHORT, "variant=BC", "boosting.fold=always"),
    "folded networks": (*DQN, "variant=SBC", "boosting.fold=always"),
    "folded lines": (*SHORT, "variant=BC", "algorithm/regressor=sklearn"),
}
KINDS["folded networks"] += ("boosting.fold_loss=2",)
KINDS["folded lines"] += ("algorithm.regressor.estimator=Ridge", "boosting.fold=1")
KINDS["sklearn's forest"] += ("algorithm.regressor.trees=3",)


def run(folder: Path, *overrides: str) -> Plan:
    """Run what `bcrl *overrides runs_dir=folder` would."""
    made = plan(*overrides, f"runs_dir={folder}")
    runner.run(made)
    return made


def at_row(
    patch: pytest.MonkeyPatch, number: int, act: Callable[[], object]
) -> list[int]:
    """Let `act` happen when a run has measured so many rows; all counts so far."""
    write, seen = loggers.write, list[int]()

    def counted(writer: loggers.Writer, index: str, row: loggers.Row) -> None:
        write(writer, index, row)
        seen.append(row[index])
        if len(seen) == number:
            act()

    patch.setattr(loggers, "write", counted)
    return seen


def results(made: Plan, seed: int) -> tuple[bytes, bytes]:
    """A seed's CSV and NPZ."""
    csv, npz = (seed_path(made.directory, seed, s) for s in ("csv", "npz"))
    return csv.read_bytes(), npz.read_bytes()


def about(made: Plan, seed: int) -> dict:
    """A seed's JSON."""
    return json.loads(seed_path(made.directory, seed, "json").read_text())


def resealed(path: Path, **entries) -> None:
    """Change a JSON and its digest."""
    document = json.loads(path.read_text()) | entries
    path.write_text(files.sealed(document))


def rows(made: Plan, seed: int) -> list[dict[str, float]]:
    """A seed's CSV; an empty cell is NaN."""
    return pd.read_csv(seed_path(made.directory, seed, "csv")).to_dict("records")


def compared(calm: Plan, other: Plan) -> str | None:
    """How a folder differs from an undisturbed run's, except for times in the JSON."""
    names = {file.name for file in calm.directory.iterdir()}
    found = {file.name for file in other.directory.iterdir()}
    if names != found:
        return f"files: {sorted(names ^ found)}"
    for name in sorted(names):
        here, there = calm.directory / name, other.directory / name
        if name.endswith("json"):
            document = json.loads(there.read_text())
            if document["status"] != "complete" or not files.is_intact(document):
                return f"{name}: {document['status']}"
        elif here.read_bytes() != there.read_bytes():
            return f"{name} differs"
    return None
