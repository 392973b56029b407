"""The examples run as they are, and show what they say."""

import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


def lines(name: str, tmp_path: Path) -> list[list[str]]:
    """The cells of each line that an example prints."""
    command = [sys.executable, EXAMPLES / f"{name}.py"]
    there = {"cwd": tmp_path, "env": {**os.environ, "COLUMNS": "200"}}
    done = subprocess.run(command, **there, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.iterdir())  # a script leaves no files
    return [line.split() for line in done.stdout.splitlines()]


def shown(name: str, tmp_path: Path) -> pd.DataFrame:
    """The frame that an example prints, its first columns as the index."""
    cells = lines(name, tmp_path)[2:]
    width = max(map(len, cells))
    return pd.DataFrame([row + [""] * (width - len(row)) for row in cells]).set_index(0)


def test_all_examples_are_tested():
    names = {path.stem for path in EXAMPLES.glob("*.py")}
    own = {"own_env", "own_compiled_env", "own_curriculum", "own_regressor"}
    own |= {"offline_data"}
    assert names == own | {"minimal_bc_fqi", "minimal_sbc_dqn"}


@pytest.mark.slow
def test_the_minimal_bc_fqi_beats_fqi_in_the_target_task(tmp_path):
    rows = lines("minimal_bc_fqi", tmp_path)[1:]
    returns = {tuple(row[:2]): float(row[2]) for row in rows}
    assert len(returns) == 4
    assert returns["BC-FQI", "1.2"] > returns["FQI", "1.2"] + 0.1


@pytest.mark.slow
def test_the_minimal_sbc_dqn_arrives_where_dqn_does_not(tmp_path):
    rows = lines("minimal_sbc_dqn", tmp_path)[1:]
    returns = {tuple(row[:2]): float(row[2]) for row in rows}
    assert len(returns) == 6
    assert returns["DQN", "6000"] == -150.0
    assert returns["SBC-DQN", "6000"] > -120.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["own_env", "own_curriculum"])
def test_boosting_through_the_curriculum_beats_learning_from_scratch(name, tmp_path):
    solved = shown(name, tmp_path)[2].astype(float)
    assert solved["FQI"] == 0.0
    assert solved["BC-FQI"] >= 0.6
    assert solved["BC-FQI"] >= solved["C-FQI"]


@pytest.mark.slow
def test_a_compiled_environment_is_learned(tmp_path):
    assert float(shown("own_compiled_env", tmp_path).loc["3", 2]) >= 0.6


@pytest.mark.slow
def test_any_regressor_of_scikit_learn_fits_residuals(tmp_path):
    table = shown("own_regressor", tmp_path)
    returns = table.loc[["RBF", "forest"], 3].astype(float)  # of the first task
    assert (returns.abs() <= 1.0).all()


@pytest.mark.slow
def test_logs_of_a_random_policy_teach_more_than_it_can(tmp_path):
    returns = shown("offline_data", tmp_path)[1].astype(float)
    assert (returns[["B-FQI", "BC-FQI"]] > 50.0).all()
