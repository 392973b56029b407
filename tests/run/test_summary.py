"""What a command says at its end, and what tags stand for."""

import shlex
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bcrl.config import tags
from bcrl.report import cli as report
from bcrl.report.choose import folders_of
from bcrl.report.load import load_chosen, load_runs
from bcrl.report.tables import sweep_table
from bcrl.results.layout import DQN_METRICS
from bcrl.results.outcomes import outcome
from bcrl.run import runner, status
from bcrl.run.summary import summary
from tests.conftest import arguments, plan, plans
from tests.report.runs import dqn_table
from tests.results.made_up import made_up_plan, rerecord, write_seeds

TABULAR = ("env=maze", "algorithm/regressor=tabular", "scale=smoke", "seeds.count=2")
SWEEP = (*TABULAR, "variant=plain,BC", "algorithm.episodes=60,80")


def cells(text: str, folder: Path) -> list[str]:
    """The cells of a folder's row."""
    (row,) = (line for line in text.splitlines() if line.startswith(f"{folder} "))
    return [cell.strip() for cell in row.split("  ") if cell.strip()][1:]


def hill(folder: Path, name: str, values: list[float], solved: bool = False):
    """A plan whose seeds end with these returns, after another one."""
    config = {"env": {"name": "hill", "metrics": ["return", *["solved"] * solved]}}
    made = made_up_plan(folder, "hill", name, range(len(values)), config=config)

    def table(seed: int) -> pd.DataFrame:
        columns = {"stage": 1, "task": 1, "iteration": [1, 2]}
        columns["return"] = [-9.0, values[seed]]
        return pd.DataFrame(
            columns | {"solved": [0.0, seed % 2]} if solved else columns
        )

    write_seeds(made, table, facts={"cpu_seconds": 1800.0})
    return made


def test_few_seeds_are_listed_and_of_more_there_is_an_interval(tmp_path):
    few = hill(tmp_path, "FQI", [1.5, -2.0])
    many = hill(tmp_path, "BC-FQI", [float(x) for x in range(6)], solved=True)
    text = summary([few, many], 75.0)
    assert cells(text, few.directory) == ["2 of 2", "1.500, −2.000", "–", "1.0 h"]
    seeds, returns, success, cpu = cells(text, many.directory)
    assert (seeds, success, cpu) == ("6 of 6", "50%", "3.0 h")
    assert returns.startswith("2.500 [") and "95 %" in text.splitlines()[0]


def test_a_curriculum_that_ends_elsewhere_is_judged_by_its_target(tmp_path):
    """The last of the config's tasks; DQN's window ends with its last evaluation."""
    env = {"name": "mine", "metrics": ["return"], "tasks": {"mass": [1.0, 2.0]}}
    rows = {"stage": [1, 2, 3], "task": [1, 2, 1], "iteration": [1, 2, 3]}
    step = np.arange(0, 30_000, 1000)
    steps = {
        "stage": 1 + step // 10_000,
        "task": np.repeat([1, 2, 1], 10),
        "step": step,
    }
    steps |= dict.fromkeys(DQN_METRICS, step / 1000)
    for name, table, end in (
        ("FQI", rows | {"return": [-1.0, -2.0, -3.0]}, -2.0),
        ("DQN", steps, np.mean([15, 16, 17, 18, 19])),
    ):
        made = made_up_plan(tmp_path, "mine", name, range(2), config={"env": env})
        write_seeds(made, lambda seed, table=table: pd.DataFrame(table))
        assert outcome(made.directory, 0).returned == end
        (variant,) = load_chosen([made.directory]).variants
        assert variant.final("return").tolist() == [end, end]


def test_the_end_and_the_report_show_the_same_late_returns(tmp_path):
    made = [made_up_plan(tmp_path, "linear_system", f"DQN@{x}", range(6)) for x in "ab"]
    for each in made:
        write_seeds(each, lambda seed: dqn_table("DQN", seed))
    first, _ = sweep_table(load_runs(tmp_path, "smoke")).to_dict("records")
    found = [outcome(made[0].directory, seed) for seed in range(6)]
    assert np.mean([x.returned for x in found]) == pytest.approx(first["late_return"])
    assert np.mean([x.success for x in found]) == pytest.approx(first["success_rate"])
    interval = (first["late_return_low"], first["late_return_high"])
    shown = " [{:#.4g}, {:#.4g}]".format(*interval).replace("-", "−")
    assert shown in summary(made, 1.0)


def test_a_damaged_seed_does_not_count(tmp_path):
    made = hill(tmp_path, "FQI", [1.0, 2.0, 3.0])
    path = made.directory / "seed_0001.csv"
    path.write_text(path.read_text().replace("2.0", "4.0"))
    text = summary([made], 1.0)
    assert cells(text, made.directory)[:2] == ["2 of 3", "1.000, 3.000"]
    assert "--allow-incomplete" in text.splitlines()[-1]
    rerecord(path, path.read_text())
    assert cells(summary([made], 1.0), made.directory)[1] == "1.000, 4.000, 3.000"


def test_a_sweep_is_cut_and_says_so(tmp_path):
    made = [hill(tmp_path, f"FQI@t{number}", [1.0]) for number in range(23)]
    lines = summary(made, 1.0).splitlines()
    assert sum(str(tmp_path) in line for line in lines[:-1]) == 20
    assert "… and 3 more folders" in lines


def test_a_run_ends_with_what_it_achieved_and_the_next_command(tmp_path, capsys):
    root = tmp_path / "my runs"
    swept = plans(*SWEEP, f"runs_dir='{root}'", multirun=True)
    runner.run(*swept)
    text = capsys.readouterr().err
    for each in swept:
        values = [outcome(each.directory, seed).returned for seed in each.seeds]
        shown = ", ".join(f"{x:#.4g}".replace("-", "−") for x in values)
        assert cells(text, each.directory)[:2] == ["2 of 2", shown]
    overviews = status.dry_run(swept), status.status(arguments(f"runs_dir='{root}'"))
    for each in swept:  # one line per tag, which both methods share
        episodes = each.config["algorithm"]["episodes"]
        meaning = f"@{each.tag}: algorithm.episodes={episodes}, "
        meaning += "algorithm.regressor.name=tabular"
        assert text.splitlines().count(meaning) == 1
        assert all(meaning in table.splitlines() for table in overviews)
    command = shlex.split(text.splitlines()[-1].removeprefix("next: "))
    asked = report._parser().parsed(command[1:])
    assert command[0] == "bcrl-report" and not asked.allow_incomplete
    found = folders_of(asked.runs_dir, asked.scale, asked.env, asked.compare)
    assert found == [each.directory.resolve() for each in swept]


def test_nothing_is_shown_without_progress(tmp_path, capsys):
    runner.run(plan(*TABULAR, f"runs_dir={tmp_path}", "progress=none"))
    assert capsys.readouterr() == ("", "")


def test_debug_says_where_its_files_are(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    made = plan("env=maze", "algorithm/regressor=tabular", "debug=on")
    runner.run(made)
    assert cells(capsys.readouterr().err, made.directory)[0] == "1 of 1"


def test_a_tag_stands_for_what_differs(tmp_path):
    def settings(*words: str) -> dict:
        made = plan("env=maze", "scale=smoke", f"runs_dir={tmp_path}", *words)
        runner.records.make_run_directory(made)
        assert tags.settings_of(made.directory, ()) == made.settings
        return made.settings

    assert settings() == settings("tag=x") == {}
    assert settings("algorithm.episodes=7") == {"algorithm.episodes": 7}
    named = settings("algorithm.episodes=7", "env.gamma=0.9", "tag=y", "variant=BC")
    assert named == {"algorithm.episodes": 7, "env.gamma": 0.9}
    own = ("env=gymnasium", "env.id=CartPole-v1", "algorithm.episodes=7")
    assert settings(*own) == {"algorithm.episodes": 7}


STRANGE = ("", "[]", "\0", "a: [", "env: {id: 3}", "env: {id: 'x, env=maze'}")


@pytest.mark.parametrize("text", STRANGE)
def test_a_strange_config_has_no_meaning(tmp_path, text):
    folder = tmp_path / "smoke" / "strange" / "FQI@t"
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(text)
    assert tags.settings_of(folder, ()) == {}


def test_one_tag_with_two_meanings_is_told_apart_by_the_folder():
    folders = [Path("runs/quick/maze", name) for name in ("FQI@t", "C-FQI@t")]
    found = tags.meanings({folder: {"a.b": folder.name} for folder in folders})
    assert found == ["maze FQI@t: a.b=FQI@t", "maze C-FQI@t: a.b=C-FQI@t"]
    (line,) = tags.meanings({folders[0]: {"k": list(range(99)), "gone": "absent"}})
    assert len(line) < 80 and line.endswith("…") and "gone" not in line


def test_the_next_command_draws_the_runs(tmp_path):
    def following(*names: str) -> list[str]:
        plans = [made_up_plan(tmp_path, "maze", name, range(0)) for name in names]
        return shlex.split(summary(plans, 1.0).splitlines()[-1])[5:]

    assert following("FQI", "BC-FQI") == []
    assert following("FQI@t", "BC-FQI@t") == ["--tag", "t"]
    assert following("FQI", "FQI@t") == ["--env", "maze", "--compare", "FQI", "FQI@t"]
    assert following(*(f"FQI@{number}" for number in range(9))) == []
