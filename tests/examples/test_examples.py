"""The examples run as they are, and show what they say."""

import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


def shown(name: str, tmp_path: Path) -> pd.DataFrame:
    """The table that an example prints, its first columns as the index."""
    done = subprocess.run(
        [sys.executable, EXAMPLES / f"{name}.py"],
        cwd=tmp_path,
        env={**os.environ, "COLUMNS": "200"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.iterdir())  # a script leaves no files
    lines = done.stdout.splitlines()
    cells = [line.split() for line in lines[2:]]
    width = max(map(len, cells))
    return pd.DataFrame([row + [""] * (width - len(row)) for row in cells]).set_index(0)


def test_all_examples_are_tested():
    names = {path.stem for path in EXAMPLES.glob("*.py")}
    assert names == {"own_env", "own_curriculum", "own_regressor"}


@pytest.mark.parametrize("name", ["own_env", "own_curriculum"])
def test_boosting_through_the_curriculum_beats_learning_from_scratch(name, tmp_path):
    solved = shown(name, tmp_path)[2].astype(float)
    assert solved["FQI"] == 0.0
    assert solved["BC-FQI"] >= 0.6
    assert solved["BC-FQI"] >= solved["C-FQI"]


def test_any_regressor_of_scikit_learn_fits_residuals(tmp_path):
    table = shown("own_regressor", tmp_path)
    returns = table.loc[["RBF", "forest"], 3].astype(float)  # of the first task
    assert (returns.abs() <= 1.0).all()
