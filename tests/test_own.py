"""What docs/own.md adds from outside the package, by its own files and commands."""

import os
import re
import shlex
from pathlib import Path

import pytest

DOC = (Path(__file__).parents[1] / "docs" / "own.md").read_text()
#: Each block of a file, whole, by the path that one of its first lines names.
FILES = [
    (name, text)
    for text, name in re.findall(
        r"```(?:python|yaml)\n((?:# @[^\n]+\n)?# ((?:code|conf)/\S+)\n.*?)```",
        DOC,
        re.S,
    )
]
COMMANDS = re.findall(r"\n(?:BCRL_TRUST=mine )?bcrl (--config-dir .*?)\n```", DOC, re.S)
RESULTS = {
    "env=swing_up variant=plain": ("FQI", "C-FQI", "BC-FQI"),
    "algorithm/regressor": ("BC-FQI@*",),
    "curriculum=in_pairs": ("BC-FQI@pairs",),
    "transfer=fade": ("Fade-C-FQI",),
    "algorithm=patient": ("BC-PATIENT",),
    "logger=lines": ("BC-FQI",),
}


def test_the_page_has_a_file_and_a_command_of_each_kind():
    folders = {str(Path(name).parent) for name, _ in FILES}
    kinds = {"env", "algorithm", "algorithm/regressor", "curriculum", "transfer"}
    assert {f"conf/{kind}" for kind in kinds} <= folders
    assert len(COMMANDS) == len(RESULTS)


@pytest.mark.parametrize(
    ("command", "names"), list(zip(COMMANDS, RESULTS.values(), strict=True))
)
def test_it_runs_from_outside(bcrl, tmp_path, monkeypatch, command, names):
    for name, text in FILES:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "code"), prepend=os.pathsep)
    small = ["scale=smoke", "seeds.count=1", "progress=none", "workers=2"]
    done = bcrl(*shlex.split(command), *small)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "runs" / "smoke" / "swing_up"
    for name in names:
        assert list(folder.glob(f"{name}/seed_0000.csv")), list(folder.iterdir())
