"""What the command says without running, a debug run, and a user's own defaults."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bcrl import cli
from bcrl.common.identity import identity
from bcrl.config import flags, jobs
from bcrl.config.hydra_compose import CONF
from bcrl.errors import BcrlError
from bcrl.q.regressors.ours import Tabular
from bcrl.run import locks, records, runner
from bcrl.run import status as overview
from tests.config.helpers import own
from tests.conftest import arguments, plan, plans

PROGRAM = "import sys; sys.argv[0] = 'bcrl'; from bcrl.cli import main; main()"
SMALL = ("env=maze", "algorithm/regressor=tabular", "scale=smoke", "progress=none")


def everything(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_the_help_names_every_group_option_and_flag_on_a_screen():
    text = flags.manual(None)
    assert len(text.splitlines()) <= 62
    for path in CONF.glob("*/*.yaml"):
        if path.parent.name not in ("budget", "tuned", "local"):
            assert re.search(rf"^  {path.parent.name} ", text, re.M), path
            assert re.search(rf"\b{path.stem}\b", text), path
    for flag in ("--dry-run", "--status", "--config-dir", "-m "):
        assert flag in text
    for code in ("0 all", "1 seeds failed", "2 bad input", "75 interrupted"):
        assert code in text


def test_every_example_of_the_help_would_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = flags.manual(None).partition("\nExamples\n")[2].split("\n\n")[0]
    examples = [shlex.split(line) for line in text.splitlines()]
    assert len(examples) >= 5
    for words in examples:
        monkeypatch.setattr(sys, "argv", [*words, "--dry-run"])
        cli.main()
        assert words[0] == "bcrl" and "nothing was run" in capsys.readouterr().out
    assert everything(tmp_path) == []


def test_help_tab_and_dry_run_import_nothing_large(tmp_path):
    program = """if True:
        import sys
        from bcrl.cli import main
        sys.argv = ["bcrl", *sys.argv[1:]]
        try:
            main()
        finally:
            large = {"torch", "numba", "scipy", "sklearn", "matplotlib", "pandas"}
            print(sorted(large & sys.modules.keys()), file=sys.stderr)
    """
    figures = ["-m", "experiment=fig1,fig4", "--dry-run"]
    for asked in (["--help"], ["-sc", "query=bash"], figures):
        command = [sys.executable, "-c", program, *asked]
        there = {"cwd": tmp_path, "env": {**os.environ, "COMP_LINE": "bcrl env="}}
        done = subprocess.run(command, **there, capture_output=True, text=True)
        assert done.stdout and done.stderr == "[]\n"


COMPLETED = """
eval "$(bcrl -sc install=bash)"
COMP_LINE="$1"; COMP_POINT=${#1}; words=($1); COMP_CWORD=$(( ${#words[@]} - 1 ))
hydra_bash_completion
echo "${COMPREPLY[@]}"
"""
TAB = {
    "bcrl env=ca": {"env=car_on_hill", "env=cart_pole"},
    "bcrl --config-dir OWN env=my": {"env=my_maze"},
    "bcrl env=maze -m curriculum=": {"curriculum=off", "curriculum=on"},
    "bcrl env=maze algorithm.reg": {"algorithm.regressor."},
    "bcrl algorithm.ep": {"algorithm.episodes=", "algorithm.epsilon="},
    "bcrl env=maze --dr": {"--dry-run"},
    "bcrl env=maze hydra.searchpath=[pkg://antigravity] boos": {"boosting="},
}


def test_help_and_tab_know_flags_options_groups_and_keys(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    mine = own(tmp_path, "name: maze", "env/my_maze")
    assert "my_maze" in flags.manual(mine)
    assert "my_maze" not in flags.manual(None).partition("Your own")[0]
    for line, proposed in TAB.items():
        found = flags.completions(line.replace("OWN", mine))
        assert {x for x in found if not x.startswith("boosting.")} == proposed
    assert {"env=", "seeds.", "workers="} <= set(flags.completions("bcrl "))
    assert flags.completions("bcrl env=nope te") == []


@pytest.mark.slow
def test_bash_proposes_them(tmp_path):
    command = tmp_path / "bin" / "bcrl"
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -c "{PROGRAM}" "$@"\n')
    command.chmod(0o755)
    words = ["bash", "--norc", "-c", COMPLETED, "bash", "bcrl env=ca"]
    there = {"PATH": f"{command.parent}:{os.environ['PATH']}"}
    there = {"cwd": tmp_path, "env": {**os.environ, **there}}
    done = subprocess.run(words, **there, capture_output=True, text=True)
    assert done.stderr == "" and done.returncode == 0
    assert set(done.stdout.split()) == TAB["bcrl env=ca"]


def test_a_dry_run_lists_what_is_left_and_writes_nothing(tmp_path):
    options = (*SMALL, f"runs_dir={tmp_path}")
    runner.run(plan(*options, "seeds.first=1", "seeds.count=1"))
    before = everything(tmp_path)
    options += ("curriculum=on,off", "seeds.count=3", "workers=2")
    swept = plans(*options, multirun=True)
    table = overview.dry_run(swept).splitlines()
    name = swept[1].name  # FQI's, whose seed 1 is complete
    (row,) = [x for x in table if x.startswith(f"{tmp_path}/smoke/maze/{name} ")]
    assert row.split()[1:4] == ["1", "0,", "2"]
    (row,) = [x for x in table if f"maze/C-{name.partition('@')[0]}@" in x]
    assert row.split()[1:3] == ["0", "0–2"]
    assert re.match(r"\d jobs, about 0\.\d core minutes, .* with workers=2", table[-1])
    assert everything(tmp_path) == before


def test_the_command_shows_tables_and_writes_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def ask(line: str) -> str:
        monkeypatch.setattr(sys, "argv", ["bcrl", *line.split()])
        cli.main()
        return capsys.readouterr().out

    assert "runs/quick/maze/C-FQI" in ask("-m env=maze curriculum=on --dry-run")
    assert ask("--status env=maze").count("quick maze") == 1
    assert "height" in ask("env=maze --cfg job")
    with pytest.raises(SystemExit, match="2"):
        ask("--status")
    assert "holds no runs" in capsys.readouterr().err
    assert everything(tmp_path) == []


def states(text: str) -> dict[str, list[int]]:
    """Row by row: seeds, complete, running, interrupted, failed, damaged, waiting."""
    head, *rows = text.splitlines()
    words = ("seeds", *records.STATES)
    ends = [re.search(rf"\b{word}\b", head).end() for word in words]
    found = {}
    for row in rows[: [x.startswith("in all") for x in rows].index(True)]:
        cells = [row[:end].rsplit("  ", 1)[-1].strip() for end in ends]
        found[row.split("  ")[0]] = [int(cell or 0) for cell in cells]
    return found


def test_the_overview_tells_states_apart_by_locks_and_files(tmp_path):
    options = (*SMALL, f"runs_dir={tmp_path}", "tag=t")
    runner.run(plan(*options, "seeds.count=2"))
    p = plan(*options, "seeds.count=6")
    for seed, status in ((2, "running"), (3, "running"), (4, "failed: key=1: no")):
        records.write_status(p, seed, status, {})
    computing = locks.Lock(p.directory, "seed_0002")
    assert computing.acquire()
    before = everything(tmp_path)
    # What this command would run, and all that was ever begun.
    for typed in ((*options, "seeds.count=6"), (f"runs_dir={tmp_path}",)):
        said = overview.status(asked := arguments(*typed))
        assert states(said) == {"smoke maze FQI@t": [6, 2, 1, 1, 1, 0, 1]}
        assert "FQI@t, seed 4: failed: key=1: no" in said
    assert everything(tmp_path) == before and computing.holds()
    computing.release()
    assert states(overview.status(asked))["smoke maze FQI@t"] == [6, 2, 0, 2, 1, 0, 1]


def test_debug_is_small_strict_alone_and_apart(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    p = plan("env=maze", "variant=BC", "algorithm/regressor=tabular", "debug=on")
    assert p.root.parent == Path("runs/.debug") and p.config["workers"] == 1
    assert p.seeds == (0,) and p.name.startswith("BC-FQI")
    runner.run(p)
    assert 0 not in records.pending(p)


def test_strict_makes_errors_of_numpys_warnings(tmp_path, monkeypatch):
    monkeypatch.setattr(Tabular, "fit", lambda *_: np.zeros(1) / np.zeros(1))
    p = plan(*SMALL, "strict=true", f"runs_dir={tmp_path}", "seeds.count=1")
    with pytest.raises(runner.SeedsFailed, match="FloatingPointError: invalid"):
        runner.run(p)


def test_a_local_file_sets_a_users_paths_and_the_command_line_wins(tmp_path):
    text = "{runs_dir: elsewhere, workers: 2, checkpoint_every: 5}"
    mine = own(tmp_path, text, "local/default")
    own(tmp_path, "workers: 4", "local/cluster")
    ways = ("", "elsewhere", 2), ("workers=3 experiment=fig5", "elsewhere", 3)
    ways += ("local=none", "runs", 1), ("local=cluster", "runs", 4)
    for typed, root, workers in ways:
        (p,) = plans("env=maze", *typed.split(), config_dir=mine)
        assert (p.config["workers"], p.root) == (workers, Path(root))
        assert p.tag is None or "fig" in typed  # the same numbers
    with pytest.raises(BcrlError, match=r"local=clutser: .*mean local=cluster\?"):
        plans("env=maze", "local=clutser", config_dir=mine)


def test_a_local_file_cannot_change_numbers_in_silence(tmp_path):
    place = "local/default"
    mine = own(tmp_path, "algorithm: {episodes: 7}", place)
    (p,) = plans("env=maze", config_dir=mine)
    assert p.config["algorithm"]["episodes"] == 7
    assert p.tag and p.directory != plan("env=maze").directory
    typed = plan("env=maze", "algorithm.episodes=7")
    assert (p.tag, identity(p.config)) == (typed.tag, identity(typed.config))
    mine = own(tmp_path / "other", "env: {_target_: a.b}", place)
    with pytest.raises(BcrlError, match="_target_"):
        plans("env=maze", config_dir=mine)


def test_the_users_folder_is_found_and_named_in_what_is_recorded(tmp_path, monkeypatch):
    mine = own(tmp_path, "runs_dir: elsewhere", "local/default")
    os.rename(mine, tmp_path / "bcrl")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["bcrl", "env=maze", "-m"])
    (p,) = jobs.plans(flags.arguments())
    assert p.root == Path("elsewhere")
    asked = flags.arguments()
    assert asked.config_dir == str(tmp_path / "bcrl") and asked.unnamed
