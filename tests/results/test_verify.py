"""The checks of result files: each thing that may be wrong, by name and remedy."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from bcrl.common import files
from bcrl.errors import BcrlError
from bcrl.report.load import load_runs
from bcrl.results import verify
from tests.results.made_up import edit_csv, made_up_plan, rerecord, reseal, write_seeds

HEADER = "stage,task,iteration,q_error,return\n"


def table(seed: int) -> pd.DataFrame:
    rng = np.random.default_rng(seed)
    index = {"stage": [1, 1, 2, 2], "task": 2, "iteration": range(1, 5)}
    return pd.DataFrame(index | {"q_error": rng.random(4), "return": rng.random(4)})


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A variant of four complete seeds, alone in the tree `tmp_path`."""
    plan = made_up_plan(tmp_path, "car_on_hill", "BC-FQI@mine", range(4))
    write_seeds(plan, table, facts={"command": "bcrl env=car_on_hill"})
    return plan.directory


@pytest.fixture
def verified(tmp_path, capsys):
    """Runs bcrl-verify on `tmp_path`: exit code and lines."""

    def run() -> tuple[int, list[str]]:
        code = verify.main([str(tmp_path)])
        return code, capsys.readouterr().out.splitlines()

    return run


def test_nothing_wrong(folder, tmp_path, verified):
    """Other files, other white space and keys that decide no number are no fault."""
    for name in (".seed_0007.lock", ".seed_0001.csv.77.tmp", "checkpoint_0007.npz"):
        (folder / name).write_text("")
    path = folder / "seed_0001.json"
    path.write_text(path.read_text().replace("\n", "\n\n"))
    path = folder / "config.yaml"
    path.write_text("# a remark\n" + path.read_text() + "workers: 12\n")
    assert verified() == (0, ["1 variants, 4 seeds complete; nothing wrong"])


#: File, its new content or entries of its JSON to be resealed, a part of the message.
BROKEN = [
    ("seed_0001.json", '{"status": "compl', "JSON"),
    ("seed_0001.json", "[" * 100_000, "JSON"),
    ("seed_0001.json", {"schema": 1}, "schema 1, not 2"),
    ("seed_0001.json", {"seed": 4}, "seed 4, not 1"),
    ("seed_0001.json", {"tag": None}, "tag None, not 'mine'"),
    ("seed_0001.json", lambda text: text.replace(": 5", ": 5.0"), "digest"),
    ("seed_0001.json", None, "missing"),
    ("seed_0001.csv", None, "missing"),
    ("seed_0001.csv", HEADER, "SHA-256"),
    ("seed_0001.npz", "PK", "SHA-256"),
    ("seed_0001 (copy).csv", HEADER, "name"),
    ("config.yaml", None, "missing"),
    ("config.yaml", "env: [", "config"),
    ("config.yaml", "env: {}", "algorithm.episodes: there"),
]


def spoil(path: Path, how) -> None:
    if how is None:
        path.unlink()
    elif isinstance(how, dict):
        reseal(path, **how)
    else:
        path.write_text(how if isinstance(how, str) else how(path.read_text()))


@pytest.mark.parametrize(("name", "how", "what"), BROKEN)
def test_what_is_broken_is_named(folder, tmp_path, verified, name, how, what):
    spoil(folder / name, how)
    code, lines = verified()
    assert (code, len(lines)) == (2, 2) and lines[1].endswith("complete; 1 broken")
    assert lines[0].startswith(f"broken: {folder / name} ") and what in lines[0]
    assert any(f": {do} " in lines[0] for do in ("delete", "move it", "put it"))
    for allowed in (False, True):
        with pytest.raises(BcrlError) as rejection:
            load_runs(tmp_path, "smoke", allow_incomplete=allowed)
        assert f"{folder / name} " in str(rejection.value)


@pytest.mark.parametrize("key", ["status", "asked", "config", "sha256"])
def test_a_seeds_json_that_lacks_an_entry_is_broken(folder, verified, key):
    path = folder / "seed_0001.json"
    document = json.loads(path.read_text())
    del document[key], document[files.DIGEST]
    path.write_text(files.sealed(document))
    code, lines = verified()
    assert code == 2 and lines[0].startswith(f"broken: {path.with_suffix('')}.")
    assert f"delete {path.with_suffix('')}.*" in lines[0]


#: Tables that were recorded as they are, and yet can't be right.
TABLES = [
    (lambda t: t[:0], "has no rows"),
    (lambda t: t.drop(columns="return"), "has the header stage,task,"),
    (lambda t: t.assign(extra=1), "expected stage,task,iteration,q_error,return"),
    (lambda t: t.assign(stage="one"), "number"),
    (lambda t: t[::-1], "iterations that fall"),
    (lambda t: t.assign(iteration=[2, 4, 6, 9]), "stage 2's iterations"),
    (lambda t: t.assign(iteration=[2, 4, 6, 6]), "stage 2's iterations"),
    (lambda t: t.assign(stage=[1, 2, 1, 2]), "stages that fall"),
    (lambda t: t.assign(task=0), "task"),
    (lambda t: t.assign(q_error=[1, 2, np.nan, 4]), "q_error in row 3"),
    (lambda t: t.assign(**{"return": np.inf}), "return in row 1"),
    (lambda t: t[:3], "seed_0001.csv (3 rows, not 4)"),
    (lambda t: t.assign(stage=1, task=1), "seed_0001.csv (stage, task)"),
    (None, "is not a readable CSV"),
]


@pytest.mark.parametrize(("edit", "what"), TABLES)
def test_tables_that_cannot_be_right_are_named(folder, verified, edit, what):
    path = folder / "seed_0000.csv"
    edit_csv(path, edit) if edit else rerecord(path, b"")
    code, lines = verified()
    assert (code, len(lines)) == (2, 2)
    assert lines[0].startswith(f"broken: {path} ") and what in lines[0]
    assert f": delete {folder}/seed_0000.* and " in lines[0]


DIFFERENCES = [
    ({"episodes": 6}, "(algorithm.episodes: there "),
    ({"episodes": 5.0}, "(types of values)"),
    ({"a": 1, "b": 2, "c": 3, "d": 4}, "; algorithm.c: there "),
]


@pytest.mark.parametrize(("changes", "what"), DIFFERENCES)
def test_a_config_that_is_not_the_seeds_is_named(folder, verified, changes, what):
    path = folder / "config.yaml"
    config = yaml.safe_load(path.read_text())
    config["algorithm"] |= changes
    path.write_text(yaml.safe_dump(config, sort_keys=False))
    _, lines = verified()
    assert f"{path} " in lines[0] and what in lines[0]


def test_a_seed_of_another_config_is_named(folder, tmp_path, verified):
    made = made_up_plan(tmp_path, "car_on_hill", "BC-FQI@mine", range(4)).config
    other = made | {"algorithm": made["algorithm"] | {"episodes": 6}}
    reseal(folder / "seed_0003.json", config=other)
    code, lines = verified()
    assert code == 2 and f"{folder}/seed_0003.json " in lines[0]
    assert "(algorithm.episodes: there 5, here 6): delete" in lines[0]
    # What changes no number may differ.
    reseal(folder / "seed_0003.json", config=made | {"workers": 9, "progress": "bar"})
    assert verified()[0] == 0


INCOMPLETE = [
    ("seed_0001.json", {"status": "running", "sha256": {}}, ' "running"'),
    ("seed_0001.json", {"status": "failed: why"}, ' "failed: why"'),
    ("seed_0001.*", None, " lacks seeds 1,"),
    ("seed_000[13].*", None, " lacks seeds 1, 3,"),
    ("seed_*", None, " has no seeds"),
    ("seed_0003.json", {"asked": [[0, 19]]}, " lacks seeds 4–19"),  # by a later command
]


@pytest.mark.parametrize(("pattern", "how", "what"), INCOMPLETE)
def test_what_is_incomplete_is_named(folder, tmp_path, verified, pattern, how, what):
    for path in list(folder.glob(pattern)):
        spoil(path, how)
    code, lines = verified()
    assert code == 1 and lines[-1].endswith("complete; 1 incomplete")
    assert lines[0].startswith(f"incomplete: {folder}") and what in lines[0]
    assert ("`bcrl env=car_on_hill`" in lines[0]) == ("no seeds" not in what)
    assert ("wait" in lines[0]) == ("running" in what)
    with pytest.raises(BcrlError, match="--allow-incomplete"):
        load_runs(tmp_path, "smoke")


@pytest.mark.parametrize("name", ["", "nowhere"])
def test_no_folder_no_runs(tmp_path, capsys, name):
    assert verify.main([str(tmp_path / name)]) == 2
    assert f"bcrl-verify: {tmp_path / name} " in capsys.readouterr().err


def test_a_folder_that_cannot_be_read_is_named(folder, verified, monkeypatch):
    def iterdir(path: Path):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", iterdir)
    code, lines = verified()
    assert code == 2
    assert lines[0].endswith("can't be read (Permission denied): make it readable")


def test_names_that_no_terminal_prints_are_escaped(folder, verified):
    (folder / "seed_\udcff\n.csv").write_text("")
    code, lines = verified()
    assert code == 2 and r"seed_\udcff\n.csv' " in lines[0]


def test_numbers_as_keys_are_sealed_as_the_texts_that_they_become():
    document = {"line_search": {2: "a", 10: "b"}}  # by stage; "10" < "2"
    assert files.is_intact(json.loads(files.sealed(document)))
