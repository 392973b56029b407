"""What docs/howto/own.md adds from outside the package, by its files and commands."""

import json
import os
import re
import shlex
import sys
from pathlib import Path

import pandas as pd
import pytest

from bcrl import cli

DOC = (Path(__file__).parents[1] / "docs" / "howto" / "own.md").read_text()
#: Each block of a file, whole, and the path that one of its first lines names.
FILES = re.findall(
    r"```(?:python|yaml)\n((?:# @[^\n]+\n)?# ((?:code|conf)/\S+)\n.*?)```", DOC, re.S
)
COMMANDS = re.findall(r"```sh\nbcrl (--config-dir .*?)\n```", DOC, re.S)
#: A part of each command, and what it makes.
RESULTS = {
    "env=swing_up variant=plain": ("FQI", "C-FQI", "BC-FQI"),
    "algorithm/regressor": ("BC-FQI@*",),
    "curriculum=in_pairs": ("BC-FQI@pairs",),
    "transfer=fade": ("Fade-C-FQI",),
    "algorithm=patient": ("BC-PATIENT",),
    "logger=lines": ("BC-FQI",),
}
CASES = list(zip(COMMANDS, RESULTS.values(), strict=True))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The page's files, and their code on Python's path."""
    place = tmp_path_factory.mktemp("own")
    for text, name in FILES:
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_text(text)
    code = str(place / "code")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(code)
        patch.setenv("PYTHONPATH", code, prepend=os.pathsep)  # of workers
        yield place


@pytest.mark.slow
@pytest.mark.parametrize(("command", "names"), CASES)
def test_it_runs_from_outside(folder, monkeypatch, command, names):
    monkeypatch.chdir(folder)
    workers = 2 if "regressor" in command else 1  # processes that import the code
    runs = folder / "runs" / str(len(command))
    small = ["scale=smoke", "seeds.count=2", "progress=none", f"workers={workers}"]
    small += ["seeds.lockstep=1", f"runs_dir={runs}"]
    monkeypatch.setattr(sys, "argv", ["bcrl", *shlex.split(command), *small])
    cli.main()
    for name in names:
        (made,) = runs.glob(f"smoke/swing_up/{name}/seed_0001.csv")
    for log in runs.glob(".lines/smoke/swing_up/BC-FQI/seed_0001.jsonl"):
        lines = [json.loads(line)["return"] for line in log.read_text().splitlines()]
        assert lines == pd.read_csv(made)["return"].tolist()
    assert (runs / ".lines").exists() == ("logger" in command)
