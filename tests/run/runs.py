"""Small choices of whole runs, how to run them, and how to compare their folders."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from bcrl.common import files
from bcrl.config.plan import Plan
from bcrl.results.layout import seed_path
from bcrl.run import runner
from tests.conftest import plan

FQI = ("scale=smoke", "progress=none", "seeds.count=2")
MAZE = ("env=maze", "variant=BC", *FQI)
LINEAR = ("env=linear_system", "algorithm=dqn", "scale=smoke", "progress=none")
#: DQN in a second: 40 updates after the random steps, with several target copies.
DQN = (*LINEAR, "seeds.count=2", "scale.max_steps=540", "algorithm.target_update=7")
DQN += ("algorithm.evaluation_episodes=3", "tag=x")
METHODS = ("plain", "C", "BC", "SC", "SBC", "RPL", "PPR")
RELEASED = ("BC_released", "SC_released", "SBC_released")


def dqn(variant: str) -> tuple[str, ...]:
    """The overrides of a small DQN run; RPL's offset is shorter than the run."""
    return (*DQN, f"variant={variant}", *["transfer.offset=510"] * (variant == "RPL"))


def run(folder: Path, *overrides: str) -> Plan:
    """Run what `bcrl *overrides runs_dir=folder` would."""
    made = plan(*overrides, f"runs_dir={folder}")
    runner.run(made)
    return made


def results(made: Plan, seed: int) -> tuple[bytes, bytes]:
    """A seed's CSV and NPZ."""
    csv, npz = (seed_path(made.directory, seed, s) for s in ("csv", "npz"))
    return csv.read_bytes(), npz.read_bytes()


def about(made: Plan, seed: int) -> dict:
    """A seed's JSON."""
    return json.loads(seed_path(made.directory, seed, "json").read_text())


def rows(made: Plan, seed: int) -> list[dict[str, float]]:
    """A seed's CSV; an empty cell is NaN."""
    lines = csv.DictReader(seed_path(made.directory, seed, "csv").open())
    return [{key: float(cell or "nan") for key, cell in x.items()} for x in lines]


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
