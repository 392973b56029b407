"""What surrounds a run: caches, streams, variables, other people's files and Slurm."""

import io
import os
import shlex
import subprocess
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest

from bcrl import api, cli
from bcrl.common import compiling, files, terminal
from bcrl.common.divergence import diverging
from bcrl.errors import BcrlError
from bcrl.report import statistics, style
from bcrl.report.learning import figure_curves
from bcrl.report.load import load_runs
from bcrl.report.seedfiles import command
from bcrl.run import launchers, progress, records, runner
from bcrl.run import status as overview
from bcrl.run.workers import cores
from tests.conftest import arguments, plan
from tests.made_up import made_up_plan, write_seeds

# --- compiled code


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-7])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def folder_instead(path: Path) -> None:
    path.unlink()
    path.mkdir()


DAMAGES = {
    "empty": lambda path: path.write_bytes(b""),
    "short": lambda path: path.write_bytes(path.read_bytes()[:20]),
    "cut": cut,
    "flipped": flip,
    "foreign": lambda path: path.write_bytes(os.urandom(500)),
    "a folder": folder_instead,
    "a dangling link": lambda path: (path.unlink(), path.symlink_to("nowhere")),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_index_of_compiled_code_is_made_anew(tmp_path, damage):
    kept = compiling.Files(str(tmp_path), "f-1.py3", "source")
    kept.save("float", {"code": 1})
    damage(next(tmp_path.glob("*.nbi")))
    assert kept.load("float") is None
    kept.save("int", {"code": 2})  # into the file that holds float's code
    assert kept.load("float") is None
    assert kept.load("int") == (None if damage is folder_instead else {"code": 2})


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_damaged_compiled_code_counts_as_absent_and_is_replaced(tmp_path, damage):
    kept = compiling.Files(str(tmp_path), "f-1.py3", "source")
    kept.save("float", {"code": 1})
    kept.save("int", {"code": 2})
    damage(next(tmp_path.glob("*1.nbc")))
    assert (kept.load("float"), kept.load("int")) == (None, {"code": 2})
    kept.save("float", {"code": 3})
    again = None if damage is folder_instead else {"code": 3}
    assert (kept.load("float"), kept.load("int")) == (again, {"code": 2})


def test_code_of_an_older_source_is_never_loaded_and_gives_its_place(tmp_path):
    older = compiling.Files(str(tmp_path), "f-1.py3", "older source")
    older.save("float", "older")
    newer = compiling.Files(str(tmp_path), "f-1.py3", "newer source")
    assert newer.load("float") is None
    newer.save("float", "newer")
    assert (older.load("float"), newer.load("float")) == (None, "newer")
    assert len(list(tmp_path.glob("*.nbc"))) == 1


def doubling():
    @compiling.kept
    def double(x):
        return 2 * x

    return double


@pytest.mark.parametrize("damage", [None, cut])
def test_a_function_is_compiled_whatever_became_of_its_cache(
    tmp_path, monkeypatch, damage
):
    monkeypatch.setattr(compiling.numba.config, "CACHE_DIR", str(tmp_path))
    assert doubling()(4) == 8
    (path,) = tmp_path.rglob("*double*.nbc")
    if damage:
        damage(path)
    again = doubling()
    assert again(4) == 8
    assert sum(again.stats.cache_hits.values()) == (damage is None)


def test_without_a_folder_code_is_compiled_and_a_sentence_says_so(monkeypatch):
    impl = compiling.caching.CompileResultCacheImpl
    monkeypatch.setattr(impl, "_locator_classes", [compiling.Nowhere])
    monkeypatch.setattr(compiling.Nowhere, "tried", None)
    assert compiling.why_uncached() is None
    assert doubling()(5) == 10
    said = compiling.why_uncached()
    assert "NUMBA_CACHE_DIR" in said and str(Path(__file__).parent) in said


def test_a_folder_that_has_vanished_costs_only_time(tmp_path):
    kept = compiling.Files(str(tmp_path / "gone"), "f-1.py3", "source")
    kept.save("float", 1)
    assert kept.load("float") is None and not (tmp_path / "gone").exists()


def test_numba_that_may_not_compile_is_told_of(monkeypatch):
    monkeypatch.setattr(compiling.numba.config, "DISABLE_JIT", 1)
    with pytest.raises(BcrlError, match="NUMBA_DISABLE_JIT"):
        plan("env=maze")


# --- home, variables, streams


def no_home() -> Path:
    raise RuntimeError("no home")


def test_no_home_is_no_folder_and_a_relative_one_is_ignored(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", "")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert files.user_folder("XDG_CONFIG_HOME", ".config") == tmp_path / ".config"
    monkeypatch.setenv("XDG_CONFIG_HOME", "relative")
    assert files.user_folder("XDG_CONFIG_HOME", ".config") == tmp_path / ".config"
    monkeypatch.setenv("XDG_CONFIG_HOME", "~/mine")
    assert files.user_folder("XDG_CONFIG_HOME", ".config") == tmp_path / "mine"
    monkeypatch.setenv("XDG_CONFIG_HOME", "")
    monkeypatch.setattr(Path, "home", no_home)
    assert files.user_folder("XDG_CONFIG_HOME", ".config") is None


@pytest.mark.parametrize("value", ["", "0", "-1", "2(x3)", "abc", "1.5", " "])
def test_a_variable_that_is_no_number_is_ignored(value, monkeypatch):
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", value)
    assert cores() == len(os.sched_getaffinity(0))
    monkeypatch.setenv("NUMBA_NUM_THREADS", value)
    terminal.ready()
    assert "NUMBA_NUM_THREADS" not in os.environ


def test_a_bar_that_cannot_be_is_lines(monkeypatch, capsys):
    class Refuses(progress.tqdm):
        def __init__(self, **_):
            raise ValueError("could not convert string to float: 'abc'")  # TQDM_…=abc

        def __del__(self): ...

    monkeypatch.setattr(progress, "tqdm", Refuses)
    shown = progress.Progress([progress.Job("maze", "k", (0,), 1, "i", 1.0)], 1, "bar")
    shown.tick(progress.Tick(0, 1, 1, 1.0))
    shown.close()
    assert "100%" in capsys.readouterr().err


def test_an_ascii_terminal_gets_escapes(monkeypatch):
    out = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", out)
    terminal.ready()
    terminal.show("ϱ – 1")
    assert out.buffer.getvalue() == b"\\u03f1 \\u2013 1\n"


@pytest.mark.parametrize("command", ["report.cli", "report.verify"])
def test_a_full_or_closed_output_is_no_traceback(command, tmp_path):
    made(tmp_path / "runs", range(1))
    line = f"{sys.executable} -m bcrl.{command}"
    line += " --scale smoke --figures curves" * (command == "report.cli")
    for output in ("/dev/full", "/dev/null <&- 2>&-"):
        done = subprocess.run(
            f"{line} >{output}", shell=True, cwd=tmp_path, stderr=subprocess.PIPE
        )
        assert done.returncode == 0 and b"Traceback" not in done.stderr, done.stderr
        assert (b"No space left" in done.stderr) == (output == "/dev/full")


@pytest.mark.parametrize("closed", ["<&- >&- 2>&-", ">&-", "2>&-"])
def test_closed_streams_take_no_file(closed, tmp_path):
    program = (
        "from bcrl.terminal import ready, say, show; ready(); import subprocess, sys;"
        "file = open('result', 'w'); show('shown'); say('said');"
        "subprocess.run([sys.executable, '-c', 'print(1)']);"
        "file.write(str(file.fileno() > 2)); file.close()"
    )
    line = f"{shlex.join([sys.executable, '-c', program])} {closed}"
    done = subprocess.run(line, shell=True, cwd=tmp_path, capture_output=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "result").read_text() == "True"
    assert (done.stdout == b"") == (">&-" in closed.split())
    assert b"said" not in done.stdout


def test_a_report_needs_no_backend_and_no_settings_of_the_users():
    odd = {"MPLBACKEND": "module://no_such_package.backend"}
    program = "import bcrl.report, os; assert os.environ['MPLBACKEND'][:6] == 'module'"
    done = subprocess.run([sys.executable, "-c", program], env=os.environ | odd)
    assert done.returncode == 0
    mine = {"text.usetex": True, "font.family": "serif", "axes.grid": True}
    with matplotlib.rc_context(mine), style.sheet():
        seen = {key: matplotlib.rcParams[key] for key in mine}
    assert list(seen.values()) == [False, ["DejaVu Sans"], False]


# --- results that were changed


def table(seed: int) -> pd.DataFrame:
    columns = {"stage": 1, "task": 1, "iteration": [1, 2], "return": [0.5, seed]}
    return pd.DataFrame(columns)


def made(folder: Path, seeds: range, env: str = "hill"):
    result = made_up_plan(folder, env, "BC-FQI", seeds)
    write_seeds(result, table)
    return result


def copied(path: Path) -> None:
    path.write_bytes(path.with_name("seed_0000.json").read_bytes())


@pytest.mark.parametrize(
    ("suffix", "damage"),
    [
        ("csv", lambda path: path.write_text(path.read_text().replace("0.5", "0.6"))),
        ("csv", Path.unlink),
        ("npz", flip),
        ("npz", Path.unlink),
        ("json", lambda path: path.write_text(path.read_text().replace("1,", "2,", 1))),
        ("json", cut),
        ("json", lambda path: path.write_text("[" * 10**5)),
        ("json", copied),
        ("json", Path.unlink),
    ],
)
def test_a_changed_result_is_not_complete_and_is_named(tmp_path, suffix, damage):
    p = made(tmp_path, range(3))
    assert records.pending(p) == []
    assert records.damaged(p.directory, p.seeds) == {}
    damage(records.seed_path(p.directory, 1, suffix))
    assert records.pending(p) == [1]
    (why,) = records.damaged(p.directory, p.seeds).values()
    assert suffix.upper() in why
    said = overview.status(arguments(f"runs_dir={tmp_path}"))
    if suffix == "json":  # which seeds were asked for is in the others'
        assert "smoke hill BC-FQI, seed 1: " in said
    assert f"smoke hill BC-FQI, seed 1: {why}" in said


def test_a_seed_of_another_variant_is_not_complete(tmp_path):
    p = made(tmp_path, range(1))
    other = made_up_plan(tmp_path, "hill", "C-FQI", range(1))
    p.directory.rename(other.directory)
    assert records.pending(other) == [0]
    assert "another run's" in records.damaged(other.directory, [0])[0]


def test_a_rerun_makes_a_changed_seed_again_and_says_so(tmp_path, capsys):
    words = ("env=maze", "scale=smoke", "algorithm/regressor=tabular", "seeds.count=2")
    p = plan(*words, f"runs_dir={tmp_path}", "progress=none")
    runner.run(p)
    first, second = (records.seed_path(p.directory, seed, "csv") for seed in (0, 1))
    before, when = second.read_bytes(), first.stat().st_mtime_ns
    second.write_bytes(before.replace(b"1", b"2", 1))
    runner.run(p)
    assert second.read_bytes() == before and first.stat().st_mtime_ns == when
    assert "seed 1: the CSV was changed" in capsys.readouterr().err
    assert records.pending(p) == []


# --- many seeds


def test_seeds_are_in_the_order_of_their_numbers(tmp_path):
    p = made(tmp_path, range(9998, 10002))
    (p.directory / "seed_mine.csv").write_text("a\n1\n")
    assert files.seeds_of(p.directory, "csv") == [9998, 9999, 10000, 10001]
    frame = api.read(p.directory)
    assert list(dict.fromkeys(frame["seed"])) == [9998, 9999, 10000, 10001]


def test_intervals_do_not_depend_on_blocks(monkeypatch):
    values = np.random.default_rng(0).normal(size=(30, 4))
    whole = statistics.bootstrap_curves(values), statistics.bootstrap(values[:, 0])
    apart = statistics.bootstrap_difference(values[:, 0], values[:20, 1])
    monkeypatch.setattr(statistics, "BLOCK", 30 * 777)
    blocks = statistics.bootstrap_curves(values), statistics.bootstrap(values[:, 0])
    assert np.allclose(whole[0], blocks[0], rtol=1e-13) and whole[1] == blocks[1]
    assert statistics.bootstrap_difference(values[:, 0], values[:20, 1]) == apart


# --- commands


def test_recorded_commands_can_be_pasted(monkeypatch):
    words = ["/some/where/bcrl", "-m", "env.x=[1, 2]", "tag=it's"]
    monkeypatch.setattr(sys, "argv", words)
    recorded = records.provenance()["command"]
    assert shlex.split(recorded) == ["bcrl", *words[1:]]
    assert command({"command": recorded}) == recorded
    older = "/some/where/bcrl env.x=[1,2] tag=it's"  # as they once were: not quoted
    assert shlex.split(command({"command": older})) == [
        "bcrl",
        "env.x=[1,2]",
        "tag=it's",
    ]


# --- divergence


def test_values_that_run_away_diverge():
    steady = np.array([[4.0, 30.0, 2.0]])
    assert diverging({"q_error": steady, "return": steady * 1e6}) == {}
    assert diverging({"q_error": np.array([[4.0, 1300.0]])}) == {"q_error": 1300.0}
    far = {"q_mean": np.array([np.nan, -900.0]), "discounted_return": np.array([-4, 2])}
    assert diverging(far) == {"q_mean": 900.0}
    assert diverging(far | {"discounted_return": np.array([-90.0, 2.0])}) == {}
    assert diverging({"q_error": np.array([np.inf, np.nan])}) == {}


def runaway(folder: Path):
    config = {"env": {"name": "hill", "metrics": ["q_error"]}}
    for name, last in (("FQI", 3.0), ("SBC-FQI", 1300.0)):
        p = made_up_plan(folder, "hill", name, range(3), config=config)
        rows = {"stage": 1, "task": 1, "iteration": [1, 2], "q_error": [4.0, last]}
        write_seeds(p, lambda seed, rows=rows: pd.DataFrame(rows))
        yield p


def test_a_variant_that_diverges_is_named_and_flattens_no_other_curve(tmp_path):
    steady, far = runaway(tmp_path)
    assert records.diverged(steady) is None
    said = records.diverged(far)
    assert "hill SBC-FQI, seeds 0–2" in said and "q_error up to 1.3e+03" in said
    runs = load_runs(tmp_path, "smoke")
    (note,) = [note for note in runs.notes if "diverges" in note.text]
    assert note.method == "SBC-FQI" and "1.3e+03" in note.text
    (axes,) = figure_curves(runs, "hill", "FQI").axes
    low, high = axes.get_ylim()
    assert low <= 3.0 and 4.0 <= high < 5.0
    assert any("SBC-FQI" in text.get_text() for text in axes.texts)


# --- Slurm


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """Slurm's commands, of which sbatch takes so many jobs and then refuses."""

    def make(taken: int, squeue: str = "exit 0") -> None:
        commands = {
            "sbatch": f"echo >> calls; [ $(wc -l < calls) -le {taken} ] && "
            "{ echo Submitted batch job 4711; exit; }; echo QOSMaxSubmit >&2; exit 1",
            "squeue": squeue,
            "srun": "exit 0",
        }
        for name, text in commands.items():
            (tmp_path / name).write_text(f"#!/bin/bash\n{text}\n")
            (tmp_path / name).chmod(0o755)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr(launchers, "ARRAY", 2)
    words = "-m env=maze variant=BC scale=smoke seeds.count=3 hydra/launcher=slurm"
    words += " hydra.launcher.seeds_per_job=1 progress=none"
    monkeypatch.setattr(sys, "argv", ["bcrl", *words.split()])
    return make


@pytest.mark.parametrize(("taken", "code"), [(0, 2), (1, 3)])
def test_slurm_refusing_an_array_is_told_with_what_it_took(slurm, taken, code, capsys):
    slurm(taken)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == code
    said = capsys.readouterr().err
    assert "QOSMaxSubmit" in said and ("scancel 4711" in said) == bool(taken)
    assert "HYDRA_FULL_ERROR" not in said


def test_without_slurm_its_launcher_is_refused(slurm, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", "/nonexistent")
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    assert "hydra/launcher=slurm: there is no sbatch" in capsys.readouterr().err


def test_a_queue_that_never_answers_ends_the_waiting(slurm, monkeypatch, capsys):
    slurm(9, squeue="echo slurm_load_jobs error >&2; exit 1")
    monkeypatch.setattr(launchers, "PATIENCE", 0.0)
    with pytest.raises(launchers.Unattended, match=r"slurm_load_jobs error.*4711"):
        launchers._wait(["4711"], True, launchers.Stop())
    assert launchers.Unattended.exit_code == 3
