"""The checks of result files: each thing that may be wrong, by name and remedy."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bcrl.errors import BcrlError
from bcrl.report.load import load_runs
from bcrl.results import verify
from bcrl.results.integrity import check_tree
from tests.results.made_up import (
    edit_config,
    edit_csv,
    made_up_plan,
    rerecord,
    reseal,
    write_seeds,
)

HEADER = "stage,task,iteration,q_error,return\n"


def table(seed: int) -> pd.DataFrame:
    rng = np.random.default_rng(seed)
    index = {"stage": [1, 1, 2, 2], "task": 2, "iteration": range(1, 5)}
    return pd.DataFrame(index | {"q_error": rng.random(4), "return": rng.random(4)})


def arrays(seed: int) -> dict[str, np.ndarray]:
    return {"q": np.random.default_rng(seed).random((2, 3))}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A variant of four complete seeds, alone in the tree `tmp_path`."""
    plan = made_up_plan(tmp_path, "car_on_hill", "BC-FQI@mine", range(4))
    write_seeds(plan, table, arrays, {"command": "bcrl env=car_on_hill"})
    return plan.directory


def said(root: Path, capsys) -> tuple[int, list[str]]:
    """bcrl-verify's exit code and lines."""
    code = verify.main([str(root)])
    return code, capsys.readouterr().out.splitlines()


def test_nothing_wrong(folder, tmp_path, capsys):
    for name in (".seed_0007.lock", ".config.lock", ".seed_0001.csv.77.tmp"):
        (folder / name).write_text("")
    (folder / "checkpoint_0007.npz").write_text("")
    (folder / "remarks.txt").write_text("seeds look fine")
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "figure_1_smoke.png").write_text("")
    (tmp_path / "README.md").write_text("")
    path = folder / "seed_0001.json"
    path.write_text(path.read_text().replace("\n", "\n\n"))
    path = folder / "config.yaml"
    path.write_text("# a remark\n" + path.read_text() + "workers: 12\n")
    assert said(tmp_path, capsys) == (0, ["1 variant, 4 seeds complete; nothing wrong"])


def test_seeds_with_the_same_results_are_no_duplicates(tmp_path, capsys):
    """Deterministic settings give every seed the same CSV and NPZ."""
    plan = made_up_plan(tmp_path, "car_on_hill", "FQI", range(3))
    write_seeds(plan, lambda seed: table(0), lambda seed: arrays(0))
    assert said(tmp_path, capsys)[0] == 0


def test_environments_of_ones_own_may_record_anything(tmp_path, capsys):
    env = {"name": "mine", "metrics": ["angle"]}
    plan = made_up_plan(tmp_path, "mine", "FQI", range(2), config={"env": env})
    row = {"stage": 1, "task": 1, "iteration": 1, "angle": np.nan}
    write_seeds(plan, lambda seed: pd.DataFrame([row]))
    assert said(tmp_path, capsys)[0] == 0
    (plan.directory / "seed_0001.csv").write_text("stage,task,iteration,angle\n1,1,1,2")
    assert "seed_0001.csv is not what" in said(tmp_path, capsys)[1][0]


# --- what is broken: file, how it is spoilt (its new content, or entries of its JSON
# that are changed as if the run had left them so), what is said of it

BROKEN = [
    ("seed_0001.json", '{"status": "compl', "is not readable JSON"),
    ("seed_0001.json", "[" * 100_000, "is not readable JSON"),
    ("seed_0001.json", b"\xff\xfe\xfd", "is not readable JSON"),
    ("seed_0001.json", "[1]", "is not a JSON object"),
    ("seed_0001.json", "{}", "has schema None, this version reads 2"),
    ("seed_0001.json", {"schema": 1}, "has schema 1, this version reads 2"),
    ("seed_0001.json", {"seed": 4}, "belongs to seed 4, not 1"),
    ("seed_0001.json", {"scale": "paper"}, "belongs to scale 'paper', not 'smoke'"),
    ("seed_0001.json", {"env": "maze"}, "belongs to env 'maze', not 'car_on_hill'"),
    ("seed_0001.json", {"variant": "FQI"}, "belongs to variant 'FQI', not 'BC-FQI'"),
    ("seed_0001.json", {"tag": None}, "belongs to tag None, not 'mine'"),
    ("seed_0001.json", {"config": {}}, "lacks entries of schema 2"),
    ("seed_0001.json", {"config": []}, "lacks entries of schema 2"),
    ("seed_0001.json", {"status": "done"}, "lacks entries of schema 2"),
    ("seed_0001.json", {"status": 1}, "lacks entries of schema 2"),
    ("seed_0001.json", {"sha256": {}}, "lacks entries of schema 2"),
    ("seed_0001.json", {"sha256": {}, "status": "failed"}, "lacks entries of schema 2"),
    ("seed_0001.json", None, "is missing"),
    ("seed_0001.csv", None, "is missing"),
    ("seed_0001.npz", None, "is missing"),
    ("seed_0001.csv", HEADER, "is not what seed_0001.json has the SHA-256 of"),
    ("seed_0001.npz", "PK", "is not what seed_0001.json has the SHA-256 of"),
    ("seed_0001 (copy).csv", HEADER, "is not a name that bcrl gives"),
    ("seed_1.csv", HEADER, "is not a name that bcrl gives"),
    ("seed_0001.csv.bak", HEADER, "is not a name that bcrl gives"),
    ("seed_0009.json", '{"schema": 2', "is not readable JSON"),
    ("config.yaml", None, "is missing: put it back, or delete"),
    ("config.yaml", "env: [", "is not a readable config"),
    ("config.yaml", "- a list", "is not a readable config"),
    ("config.yaml", "!!int ''", "is not a readable config"),
    ("config.yaml", "env: {}", "is not its seeds' config (algorithm.episodes: there"),
]


def spoil(path: Path, how) -> None:
    if how is None:
        path.unlink()
    elif isinstance(how, dict):
        reseal(path, **how)
    else:
        path.write_bytes(how if isinstance(how, bytes) else how.encode())


@pytest.mark.parametrize(("name", "how", "what"), BROKEN)
def test_what_is_broken_is_named(folder, tmp_path, capsys, name, how, what):
    spoil(folder / name, how)
    code, lines = said(tmp_path, capsys)
    assert code == 2
    assert lines[0].startswith(f"broken: {folder / name} {what}")
    assert any(f": {do} " in lines[0] for do in ("delete", "move it", "put it"))
    assert lines[1:] == [lines[-1]] and lines[-1].endswith("complete; 1 broken")
    for allowed in (False, True):
        with pytest.raises(BcrlError) as refusal:
            load_runs(tmp_path, "smoke", allow_incomplete=allowed)
        assert f"{folder / name} {what}" in str(refusal.value)


def test_every_value_of_a_json_is_sealed(folder, tmp_path, capsys):
    path = folder / "seed_0002.json"
    path.write_text(path.read_text().replace('"episodes": 5', '"episodes": 5.0'))
    code, lines = said(tmp_path, capsys)
    assert code == 2
    assert f"{path} was changed after it was written (see its digest)" in lines[0]


def test_a_csv_without_its_json_is_named(folder, tmp_path, capsys):
    shutil.copy(folder / "seed_0001.csv", folder / "seed_0009.csv")
    code, lines = said(tmp_path, capsys)
    assert code == 2
    assert lines[0].startswith(f"broken: {folder}/seed_0009.json is missing: delete")


# --- tables that were recorded as they are, and yet can't be right

TABLES = [
    (lambda t: t[:0], "has no rows"),
    (
        lambda t: t.drop(columns="return"),
        "has the header stage,task,",
    ),
    (lambda t: t.assign(extra=1), "expected stage,task,iteration,q_error,return"),
    (lambda t: t.assign(stage="one"), "holds something not a number"),
    (lambda t: t[::-1], "does not count iterations 1 to 4"),
    (lambda t: t.assign(stage=[1, 2, 1, 2]), "has stages that fall"),
    (lambda t: t.assign(task=0), "has a task that is not a whole number"),
    (
        lambda t: t.assign(q_error=[1, 2, np.nan, 4]),
        "non-finite q_error in row 3",
    ),
    (lambda t: t.assign(**{"return": np.inf}), "has a non-finite return in row 1"),
    (lambda t: t[:3], "differs from seed_0001.csv in its length (3 rows, not 4)"),
    (lambda t: t.assign(task=1), "differs from seed_0001.csv in its task column"),
    (lambda t: t.assign(stage=1, task=1), "in its stage and task columns"),
]


@pytest.mark.parametrize(("edit", "what"), TABLES)
def test_tables_that_cannot_be_right_are_named(folder, tmp_path, capsys, edit, what):
    edit_csv(folder / "seed_0000.csv", edit)
    code, lines = said(tmp_path, capsys)
    assert code == 2
    assert lines[0].startswith(f"broken: {folder}/seed_0000.csv ")
    assert what in lines[0]
    assert f": delete {folder}/seed_0000.* and run the same command again" in lines[0]
    assert len(lines) == 2


def test_a_csv_that_is_none_is_named(folder, tmp_path, capsys):
    rerecord(folder / "seed_0000.csv", b"")
    assert "seed_0000.csv is not a readable CSV" in said(tmp_path, capsys)[1][0]


def test_a_config_that_is_not_the_seeds_is_named_with_the_difference(
    folder, tmp_path, capsys
):
    edit_config(folder / "config.yaml", "algorithm", episodes=6)
    _, lines = said(tmp_path, capsys)
    what = "is not its seeds' config (algorithm.episodes: there 6, here 5)"
    assert f"{folder}/config.yaml {what}: put it back" in lines[0]
    edit_config(folder / "config.yaml", "algorithm", episodes=5.0)
    _, lines = said(tmp_path, capsys)
    assert "is not its seeds' config (types of values)" in lines[0]
    more = {"a": 1, "b": 2, "c": 3, "episodes": 5}
    edit_config(folder / "config.yaml", "algorithm", **more, name="other")
    _, lines = said(tmp_path, capsys)
    assert "algorithm.c: there 3, here 'absent'; and 1 more)" in lines[0]


def test_a_seed_of_another_config_is_named(folder, tmp_path, capsys):
    made = made_up_plan(tmp_path, "car_on_hill", "BC-FQI@mine", range(4)).config
    other = made | {"algorithm": made["algorithm"] | {"episodes": 6}}
    reseal(folder / "seed_0003.json", config=other)
    code, lines = said(tmp_path, capsys)
    assert code == 2
    what = "has another config than config.yaml (algorithm.episodes: there 5, here 6)"
    assert f"{folder}/seed_0003.json {what}: delete {folder}/seed_0003.*" in lines[0]
    # What changes no number may differ.
    reseal(folder / "seed_0003.json", config=made | {"workers": 9, "progress": "bar"})
    assert said(tmp_path, capsys)[0] == 0


@pytest.mark.parametrize("to", ["BC-FQI", "C-FQI@mine", "../maze/BC-FQI@mine"])
def test_a_folder_copied_to_another_name_is_named(folder, tmp_path, capsys, to):
    shutil.copytree(folder, folder.parent / to)
    code, lines = said(tmp_path, capsys)
    assert code == 2
    assert len(lines) == 5
    assert all(line.count(" belongs to ") == 1 for line in lines[:4])
    assert f"{(folder.parent / to).resolve()}/seed_0000.json belongs to" in lines[0]


# --- what is incomplete

INCOMPLETE = [
    (
        "seed_0001.json",
        {"status": "running", "sha256": {}},
        '/seed_0001.json says "running": it is being computed, or its process was '
        "killed: run the same command again",
    ),
    (
        "seed_0001.json",
        {"status": "failed: non-finite weights at step 3"},
        '/seed_0001.json says "failed: non-finite weights at step 3": run the same',
    ),
    (
        "seed_0001.*",
        None,
        " lacks seed 1, which had been asked for: run the same command again (`bcrl "
        "env=car_on_hill`)",
    ),
    ("seed_000[13].*", None, " lacks seeds 1, 3, which had been asked for: run"),
    ("seed_*", None, " has no seeds: run the same command again, or move"),
]


@pytest.mark.parametrize(("pattern", "how", "what"), INCOMPLETE)
def test_what_is_incomplete_is_named(folder, tmp_path, capsys, pattern, how, what):
    for path in list(folder.glob(pattern)):
        spoil(path, how)
    code, lines = said(tmp_path, capsys)
    assert code == 1
    assert lines[0].startswith(f"incomplete: {folder}{what}")
    assert lines[-1].endswith("complete; 1 incomplete")
    with pytest.raises(BcrlError, match="--allow-incomplete draws what is complete"):
        load_runs(tmp_path, "smoke")


def test_more_seeds_asked_for_later_are_missing_until_made(folder, tmp_path, capsys):
    made = made_up_plan(tmp_path, "car_on_hill", "BC-FQI@mine", range(20)).config
    reseal(
        folder / "seed_0003.json",
        config=made,
        asked=[[0, 19]],
        command="bcrl seeds.count=20",
    )
    code, lines = said(tmp_path, capsys)
    assert code == 1
    assert "lacks seeds 4–19, which had been asked for" in lines[0]
    assert "(`bcrl seeds.count=20`)" in lines[0]
    (variant,), _ = check_tree(tmp_path)
    assert len(variant.tables) == 4 and len(variant.asked) == 20


def test_a_failed_seed_that_left_files_must_have_left_these(folder, tmp_path, capsys):
    reseal(folder / "seed_0001.json", status="failed: why")
    (folder / "seed_0001.csv").write_text(HEADER)
    code, lines = said(tmp_path, capsys)
    assert code == 2
    assert "seed_0001.csv is not what" in lines[0]
    assert lines[-1] == "1 variant, 3 seeds complete; 1 broken, 1 incomplete"


# --- the tree


def test_no_folder_no_runs(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    for path, why in (
        (tmp_path, "holds no runs"),
        (tmp_path / "nowhere", "is not a folder"),
        (tmp_path / "file", "is not a folder"),
    ):
        assert verify.main([str(path)]) == 2
        assert f"bcrl-verify: {path} {why}" in capsys.readouterr().err


@pytest.mark.parametrize("depth", range(4))
def test_a_folder_that_cannot_be_read_is_named(
    folder, tmp_path, capsys, monkeypatch, depth
):
    shut = [folder, *folder.parents][depth]
    listing = Path.iterdir

    def iterdir(path: Path):
        if path == shut:
            raise PermissionError(13, "Permission denied")
        return listing(path)

    monkeypatch.setattr(Path, "iterdir", iterdir)
    code, lines = said(tmp_path, capsys)
    assert code == 2
    assert f"broken: {shut} can't be read (Permission denied): make it" in lines[0]


def test_names_that_no_terminal_prints_are_escaped(folder, tmp_path, capsys):
    (folder / "seed_\udcff\n.csv").write_text("")
    code, lines = said(tmp_path, capsys)
    assert code == 2
    assert r"seed_\udcff\n.csv' is not a name that bcrl gives" in lines[0]
