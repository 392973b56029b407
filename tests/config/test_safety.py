"""A config can't run code, leave its folder or grow without end."""

import os
import re
import sys
import textwrap
from pathlib import Path

import pytest

import bcrl
from bcrl import cli
from bcrl.common import plugins
from bcrl.config import flags, jobs, safety, schema
from bcrl.errors import BcrlError
from bcrl.run import runner
from tests.config.helpers import own, rows
from tests.conftest import plan, plans

MAZE = "env=maze"
SLURM = "hydra/launcher=slurm"


def rejected(*overrides: str, **options) -> str:
    """The message with which `bcrl *overrides` is rejected."""
    with pytest.raises(BcrlError) as error:
        plans(*overrides, **options)
    return str(error.value)


#: By kind: overrides, each of which is rejected, with the key or value that is named.
BAD = {
    "harmful": dict(rows("harmful.txt")),
    "long": {
        "tag=" + "${device}" * 17: "tag=",
        "runs_dir='a\nb'": "runs_dir=",
        "runs_dir=" + "x" * 300: "runs_dir=",
        "runs_dir=" + "x/" * 1500: "runs_dir=",
        "tag=" + "x" * 300: "tag=",
        "tag=a\udcff": "UTF-8",
        "tag=" + "[" * 2000: "brackets",
        "+x=" + "{a:" * 2000: "brackets",
        "+" + "a." * 3000 + "a=1": "nested",
        "env.metrics=[" + "a," * 20000 + "a]": "longer",
        "seeds.count=999999999999": "seeds.count=999999999999",
        "seeds.first=1" + "0" * 5000: "seeds.first",
    },
    "sweeps": dict.fromkeys(
        (f"seeds.first=range({r})" for r in ("0,1000000000", "0,inf", "5,5")), "jobs"
    ),
}


@pytest.mark.parametrize("kind", BAD)
def test_what_could_do_harm_is_rejected_by_key_and_value(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for override, words in BAD[kind].items():
        assert words in rejected(MAZE, override, multirun=kind == "sweeps"), override
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("timeout_min", 0), ("timeout_min", 1.5), ("timeout_min", "soon")),
        *(("signal_delay_s", 99999), ("cpus_per_task", -1), ("mem_per_cpu", "lots")),
        *(("seeds_per_job", 0), ("seeds_per_job", "many"), ("setup", ["touch canary"])),
        *(("additional_parameters", {"x": "y"}), ("python", "x"), ("srun_args", ["x"])),
        *(("comment", "$(touch canary)"), ("name", "x;y"), ("submitit_folder", "../x")),
        *(("_args_", [1]), ("_partial_", True), ("x", {"_target_": "os.system"})),
        *(("_target_", "os.system"), ("_target_", None)),
    ],
)
def test_slurms_keys_are_checked_and_none_is_a_command(key, value):
    values = {"_target_": schema.SlurmQueueConf._target_, "timeout_min": 240}
    schema.check_launcher(values | {"partition": None})
    with pytest.raises(BcrlError, match=rf"hydra\.launcher\.{key}="):
        schema.check_launcher(values | {key: value})


def test_the_launchers_section_of_a_command_line_is_checked():
    assert all(made.launcher for made in plans(MAZE, SLURM, multirun=True))
    typed = "hydra.launcher.timeout_min=0"
    assert typed in rejected(MAZE, SLURM, typed, multirun=True)
    assert "workers=2" in rejected(MAZE, "hydra/launcher=joblib", multirun=True)


@pytest.mark.parametrize("more", [["hydra.launcher.n_jobs=3"], ["workers=3"]])
def test_the_former_local_launcher_is_a_number_of_workers(more, capsys):
    (made,) = plans(MAZE, "hydra/launcher=local", *more, multirun=True)
    assert made.config["workers"] == 3 and not made.launcher
    assert "hydra/launcher=local" in capsys.readouterr().err


def bomb(levels: int = 30) -> str:
    """Ten times ten times …: a few hundred bytes that mean 10^levels values."""
    tens = (f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, levels))
    return "\n".join(["a0: &a0 [x, x, x, x, x, x, x, x, x, x]", *tens]) + "\n"


def test_ordinary_yaml_is_read():
    safety.check_yaml("a: &a {x: [1, 2]}\nb: *a\nc: {<<: *a, y: !!str 3}\n")
    safety.check_yaml("a: [0, -1.5, 1e-4, 1.0e+3, .5, true, 'off', '010', a_b, 4.0]")


GROWTH = "\n".join(f"    a{i + 1}: ${{.a{i}}}${{.a{i}}}" for i in range(60))
YAMLS = {
    "an object": "tag: !!python/object/apply:os.system ['touch canary']",
    "bytes": "tag: !!binary aGk=",
    "an unknown tag": "tag: !mine x",
    "nested": "a: " + "[" * 3000 + "]" * 3000,
    "long": "a: [" + "1," * 100_000 + "1]",
    "a launcher": "hydra: {launcher: {_target_: os.system}}",
    "a factory": "hydra: {job_logging: {handlers: {x: {(): os.system}}}}",
    "a searchpath": "hydra: {searchpath: ['pkg://antigravity']}",
    "a sweep over folders": """
        hydra: {mode: MULTIRUN, sweeper: {params: {hydra.searchpath: '[pkg://this]'}}}
        """,
    "aliases": bomb(),
    "itself": "a: &a [*a]",
    "growing text": f"env:\n  x:\n    a0: xxxxxxxxxx\n{GROWTH}",
    "a package too deep": "# @package " + "a." * 400 + "a\nx: 1",
    "no mapping": "[1, 2]",
    "a folder outside": "runs_dir: a/../../x",
    "an option outside": "defaults: [../../../x]",
    "two documents": "a: 1\n---\nb: 2",
    "odd keys": "env: {null: 1, 3: {_target_: os.system}}",
    "code": "env: {name: os.path}",
    "large": "# " + "x" * 2_000_000,
}


@pytest.mark.parametrize("case", YAMLS)
def test_a_file_that_could_do_harm_is_rejected(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = own(tmp_path, YAMLS[case])
    before = set(sys.modules)
    rejected(MAZE, "experiment=mine", config_dir=folder)
    assert not {"antigravity", "this"} & (set(sys.modules) - before)
    assert [path.name for path in tmp_path.iterdir()] == ["own"]


def test_a_file_that_is_not_utf8_or_never_ends_is_rejected(tmp_path):
    folder = own(tmp_path, "tag: x")
    place = tmp_path / "own" / "experiment"
    (place / "mine.yaml").write_bytes(b"# @package _global_\ntag: '\xff\xfe'\n")
    assert "mine.yaml can't" in rejected(MAZE, "experiment=mine", config_dir=folder)
    os.mkfifo(place / "pipe.yaml")
    rejected(MAZE, "experiment=pipe", config_dir=folder)


@pytest.mark.parametrize("shown", [[], ["--info"], ["--cfg", "all"], ["--dry-run"]])
def test_a_primary_config_is_checked_whatever_is_asked(
    shown, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(runner, "run", lambda *plans: pytest.fail("it ran"))
    monkeypatch.chdir(tmp_path)
    text = "defaults: [config, _self_]\nhydra: {searchpath: ['pkg://antigravity']}"
    folder = own(tmp_path, text, "primary")
    words = ["bcrl", MAZE, f"--config-dir={folder}", "--config-name=primary"]
    monkeypatch.setattr(sys, "argv", [*words, *shown])
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    said = capsys.readouterr().err
    assert "bcrl: " in said and "Traceback" not in said
    assert "antigravity" not in sys.modules


def test_folders_that_are_typed_may_lie_outside(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert plan(MAZE, f"runs_dir={tmp_path}/../x").root == tmp_path / ".." / "x"
    assert plan(MAZE, "runs_dir='../x'").root == tmp_path / "x"
    swept = plans(MAZE, "runs_dir=../x,../y", "seeds=1", multirun=True)
    assert [p.root.name for p in swept] == ["x", "y"]


# --- whose code a config may name ---

CODE = """
    from dataclasses import dataclass

    from bcrl.envs.maze import ENV as Maze
    from bcrl.q.regressors.ours import Tabular

    @dataclass(frozen=True)
    class ENV(Maze):
        name = "my_maze"

    @dataclass(frozen=True)
    class Mean(Tabular):
        least: int = 0

    class NoData:
        pass
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder of configs that name a package `zoo` of the user's, and that package."""
    package = tmp_path / "code" / "zoo"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "broken.py").write_text("import no_such_module")
    (package / "mazes.py").write_text(textwrap.dedent(CODE))
    monkeypatch.syspath_prepend(str(tmp_path / "code"))
    maze = (Path(__file__).parents[2] / "conf/env/maze.yaml").read_text()
    text = maze.replace("name: maze", "name: zoo.mazes")
    text = re.sub("metrics: .*", "metrics: [return]", text)
    own(tmp_path, "name: zoo.mazes.Mean\nleast: 1\n", "algorithm/regressor/mean")
    yield own(tmp_path, text, "env/zoo")
    for name in [n for n in sys.modules if n.split(".")[0] == "zoo"]:
        del sys.modules[name]


NAMES_MEAN = ("algorithm/regressor=tabular", "algorithm.regressor.name=zoo.mazes.Mean")


def test_a_folder_that_is_named_may_name_code_and_a_config_alone_may_not(
    folder, tmp_path, monkeypatch
):
    def ask(*words: str):
        monkeypatch.setenv(plugins.VARIABLE, "")
        monkeypatch.setattr(sys, "argv", ["bcrl", *words])
        return jobs.plans(flags.arguments())

    words = ("env=zoo", "algorithm/regressor=mean")
    (made,) = ask(*words, "--config-dir", folder)
    assert made.target.name == "my_maze" and len(made.sources) == 64
    assert os.environ[plugins.VARIABLE] == "zoo"  # for workers
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    os.rename(folder, tmp_path / "bcrl")  # now it is found without being named
    for typed in ("tag=zoo.mazes", "env.gamma=0.9"):
        with pytest.raises(BcrlError, match=r"env\.name=zoo\.mazes.*--config-dir"):
            ask(*words, typed)
    assert ask(MAZE, *NAMES_MEAN)[0].sources == made.sources
    monkeypatch.setenv(plugins.VARIABLE, "other, zoo.mazes")
    monkeypatch.setattr(sys, "argv", ["bcrl", *words])
    assert jobs.plans(flags.arguments())


def test_tasks_name_code_as_the_environment_does():
    tasks = {"observation": ["zoo.a", None], "wrappers": [[{"name": "zoo.W"}], []]}
    found = dict(plugins.named_code({"env": {"name": "gymnasium", "tasks": tasks}}))
    assert found == {"env.tasks.observation": "zoo.a", "env.tasks.wrappers": "zoo.W"}


def test_the_sources_of_code_that_was_named_are_known(folder, tmp_path):
    before = plan(MAZE, *NAMES_MEAN).sources
    (tmp_path / "code/zoo/broken.py").write_text("import another")
    assert plan(MAZE, *NAMES_MEAN).sources != before
    assert plan(MAZE).sources == ""


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("++env.name=zoo.", "isn't the name"),
        ("++env.name=zoo.broken", "can't be imported: ModuleNotFoundError"),
        ("++algorithm.name=zoo.mazes", "has no FAMILY"),
        ("++algorithm.regressor.name=zoo.mazes.nope", "has no nope"),
        ("++algorithm.regressor.name=zoo.mazes.NoData", "dataclass"),
        ("+hydra.callbacks.x._target_=zoo.mazes.NoData", "hydra.callbacks"),
    ],
)
def test_what_a_module_lacks_is_said(folder, override, words):
    assert words in rejected(MAZE, override)


def test_nothing_that_is_read_as_data_can_be_a_pickle():
    modules = "pickle|cPickle|dill|cloudpickle|shelve|marshal|joblib"
    banned = rf"^\s*(import|from) ({modules})\b|(?<![\w.])(eval|exec|__import__)\("
    for path in Path(bcrl.__file__).parent.rglob("*.py"):
        text = path.read_text()
        if path.name == "frame.py":  # sends a script's objects to its own processes
            assert not re.search(r"\bopen\(|read_bytes|np\.load|Path", text)
            text = re.sub(r"^import (cloud)?pickle$", "", text, flags=re.M)
        assert not re.search(rf"{banned}|yaml\.load\(", text, re.M), path
        for call in re.findall(r"(?:np|numpy|torch)\.load\([^\n]*", text):
            assert re.search("allow_pickle=False|weights_only=True", call), path
