"""Wrong spellings and other tools' habits: the answer is a line, and the line works."""

import shlex
import signal
import subprocess
import sys

import pytest

from bcrl import cli
from bcrl.config import flags, jobs
from bcrl.errors import BcrlError
from bcrl.report import cli as report
from bcrl.results import verify
from bcrl.run import runner, status
from tests.config.helpers import own, rows
from tests.conftest import plan, plans

MAZE, DQN = "env=maze", "env=linear_system algorithm=dqn"
WRONG = rows("wrong_words.txt")
HEARD = {"capture_output": True, "text": True}


def asked(line: str, monkeypatch) -> str:
    """What `bcrl LINE --dry-run` shows; BcrlError as the command has it."""
    words = ["bcrl", *shlex.split(line), "--dry-run"]
    monkeypatch.setattr(sys, "argv", words)
    return status.dry_run(jobs.plans(flags.arguments()))


def check_answer(row: list[str], monkeypatch) -> None:
    """Check that a command line is rejected with the row's last cell."""
    with pytest.raises(BcrlError) as error:
        asked(" ".join(row[:-1]), monkeypatch)
    assert row[-1] in str(error.value), row


def test_some_answers_name_what_to_type(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for row in WRONG[::4]:
        check_answer(row, monkeypatch)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_every_answer_is_a_line_that_works(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for row in (row for place, row in enumerate(WRONG) if place % 4):
        check_answer(row, monkeypatch)
    for base, _, right in (row for row in WRONG if len(row) == 3):
        kept = "env=gymnasium" if right == "env.id=CartPole-v1" else base
        if "policy_reuse" in right:
            kept = f"{DQN} curriculum=on"
        if right in ("transfer=none", "hydra/sweeper=basic") or "/launcher" in right:
            kept += " curriculum=on,off" if "-m" in kept else ""
        assert "nothing was run" in asked(f"{kept} {right}", monkeypatch), right


def test_nothing_typed_shows_what_can_be(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["bcrl"])
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    shown = capsys.readouterr().out
    assert "bcrl env=maze" in shown and "bcrl --help" in shown


# --- names, seeds, times and options ---


def test_a_name_stays_what_was_typed():
    for name in ("3e563", "1e3", "2024_01_15", "007", "0x1F", "1_000", "true"):
        for typed in (name, f"'{name}'"):
            assert plan(MAZE, f"tag={typed}").name == f"FQI@{name}"
    made = plan(MAZE, "scale.name=007", "tag=t", "runs_dir=1e3")
    assert made.directory.parts[:2] == ("1e3", "007")
    for typed in ("tag=1e3,2e3", "tag=shuffle(1e3,2e3)"):
        swept = plans(MAZE, typed, "seeds=1", multirun=True)
        assert {p.name for p in swept} == {"FQI@1e3", "FQI@2e3"}
        assert plan(*shlex.split(swept[0].command)[1:]).name == swept[0].name


@pytest.mark.parametrize(
    ("typed", "seeds"),
    [
        ("seeds=5", range(5)),
        ("seeds=[3,7,11]", (3, 7, 11)),
        ("seed=3", (3,)),
        ("seed=[4,2]", (2, 4)),
        ("seeds.only=3", (3,)),
        ("seed=${oc.env:NONE_SUCH,3}", (3,)),
        ("seeds=${workers} workers=2", (0, 1)),
        ("'seeds={first: 4, count: 2}'", (4, 5)),
        ("seeds=4 seeds.first=10", range(10, 14)),
        ("seeds=[3,7,11] seeds.part=2/3", (7,)),
        ("scale=search seed=1", (1,)),
        ("seeds=[3,7] seeds.count=2", (0, 1)),
    ],
)
def test_seeds_are_how_many_or_which(typed, seeds):
    made = plan(MAZE, *shlex.split(typed))
    assert made.seeds == tuple(seeds) and made.name == "FQI"
    assert plan(*shlex.split(made.command)[1:]).seeds == made.seeds


def test_seeds_are_swept_and_stand_in_files(tmp_path):
    swept = plans(MAZE, "seed=0,4", multirun=True)
    assert [p.seeds for p in swept] == [(0,), (4,)]
    assert runner.merged(swept)[0].seeds == (0, 4)
    files = {"seeds: 2": (0, 1), "seeds: [3, 7]": (3, 7), "seed: 5": (5,)}
    for text, seeds in files.items():
        folder = own(tmp_path / str(seeds[0]), text)
        for typed, those in (((), seeds), (("seeds=1",), (0,)), (("seeds=[9]",), (9,))):
            (made,) = plans(MAZE, "experiment=mine", *typed, config_dir=folder)
            assert made.seeds == those


def test_a_command_has_one_time(tmp_path):
    folder = own(tmp_path, "runs_dir: out/${now:%H-%M-%S.%f}", "local/default")
    typed, chosen = "runs_dir=out/${now:%H-%M-%S.%f}", (MAZE, "curriculum=on,off")
    for given, place in (((typed,), None), ((), folder)):
        one, other = plans(*chosen, *given, multirun=True, config_dir=place)
        assert one.root == other.root
    assert plan(*shlex.split(plan(MAZE, typed).command)[1:]).root == one.root


def test_globs_choose_options():
    swept = plans(MAZE, "boosting=glob(o*)", multirun=True)
    assert {p.name for p in swept} == {"FQI", "B-FQI"}
    assert len(plans("experiment=glob([fig3,fig5])", multirun=True)) == 4 + 1
    with pytest.raises(BcrlError, match=r"boosting=glob.*off, on"):
        plans(MAZE, "boosting=glob(z*)", multirun=True)


@pytest.mark.parametrize(
    ("main", "typed", "right"),
    [
        (verify.main, "--rusn-dir x", "runs_dir=x"),
        (verify.main, "-v", "--version"),
        (report.main, "HERE", "runs_dir=HERE"),
        (report.main, "runs-dir: x", "runs_dir=x"),
        (report.main, "paper", "--scale paper"),
        (report.main, "env=maze", "--help"),
        (report.main, "--figures 9", "4a"),
    ],
)
def test_the_other_commands_answer_too(main, typed, right, tmp_path, capsys):
    here = str(tmp_path)
    assert main(shlex.split(typed.replace("HERE", here))) == 2
    said = capsys.readouterr().err
    assert right.replace("HERE", here) in said and "Traceback" not in said


@pytest.mark.parametrize("typed", ["runs_dir=../none", "--runs-dir ../none"])
def test_all_three_name_the_results_alike(typed, tmp_path, monkeypatch, capsys):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    words = typed.split()
    assert report.main(words) == 2 and verify.main(words) == 2
    assert capsys.readouterr().err.count("../none") == 2
    monkeypatch.setattr(sys, "argv", ["bcrl", MAZE, *words])
    assert jobs.plans(flags.arguments())[0].root == tmp_path / "none"


@pytest.mark.parametrize("main", [verify.main, report.main])
def test_they_say_which_version(main, capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["--version"])
    assert "bcrl 0." in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("line", ["bcrl", "bcrl.cli env=no", "bcrl.report.verify no"])
def test_modules_run_as_the_commands_do(line, tmp_path):
    command = [sys.executable, "-m", *line.split()]
    done = subprocess.run(command, **HEARD, cwd=tmp_path)
    assert done.returncode == 2 and done.stdout + done.stderr
    assert "Traceback" not in done.stderr


def test_ctrl_c_at_the_start_is_silent(tmp_path):
    # A shell's background jobs, and so perhaps the tests, ignore the signal.
    program = """if True:
        import os, signal as s, sys; s.signal(s.SIGINT, s.default_int_handler)
        sys.argv[0] = 'bcrl'; import bcrl
        os.kill(os.getpid(), s.SIGINT); print('alive')"""
    done = subprocess.run([sys.executable, "-c", program], **HEARD, cwd=tmp_path)
    assert done.stdout + done.stderr == "" and done.returncode == -signal.SIGINT
