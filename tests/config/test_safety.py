"""A config can't run code, leave its folder or grow without end; it is only refused."""

import ast
import os
import sys
import textwrap
import time
from pathlib import Path

import pytest

import bcrl
from bcrl import cli
from bcrl.common import plugins
from bcrl.config import bounds
from bcrl.errors import BcrlError
from bcrl.run import runner
from tests.conftest import plan, plans

MAZE = "env=maze"
CANARY = "canary"
#: What runs `touch canary` or the like when it is called or imported.
EVIL = (
    *("os.system", "posix.system", "os.popen", "os.execv", "subprocess.Popen"),
    *("subprocess.run", "builtins.eval", "builtins.exec", "builtins.__import__"),
    *("hydra.utils.call", "hydra.utils.instantiate", "hydra.utils.get_method"),
    *("hydra._internal.utils._locate", "functools.partial", "pty.spawn"),
    *("importlib.import_module", "runpy.run_path", "pickle.loads", "numpy.load"),
    *("bcrl.run.runner.run", "torch.load", "os", "", "..os.system", "a.B"),
    "hydra._internal.core_plugins.basic_launcher.Launcher",
    "hydra.experimental.callbacks.PickleJobInfoCallback",
)


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys):
    """Runs `bcrl` with bad arguments in an empty folder, and gives its message."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [])
    monkeypatch.setattr(runner, "run", lambda *plans: pytest.fail("it ran"))
    monkeypatch.delenv(plugins.VARIABLE, raising=False)

    def run(*arguments: str) -> str:
        before = sorted(tmp_path.rglob("*"))
        sys.argv = ["bcrl", *arguments]
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert ended.value.code == 2
        error = capsys.readouterr().err
        assert "bcrl: " in error and "Traceback" not in error
        assert sorted(tmp_path.rglob("*")) == before
        return error

    return run


def own(folder: Path, text: str, place: str = "experiment/mine") -> str:
    """Writes a config of one's own, and gives the option that adds its folder."""
    path = folder / "own" / f"{place}.yaml"
    path.parent.mkdir(parents=True, exist_ok=True)
    head = "# @package _global_\n" if place.startswith("experiment") else ""
    path.write_text(head + textwrap.dedent(text))
    return f"--config-dir={folder / 'own'}"


@pytest.mark.parametrize("target", EVIL)
def test_no_section_instantiates_what_is_not_registered(target, refused):
    where = ("hydra.launcher", "hydra.sweeper")
    for section in where[: 1 + EVIL.index(target) % 2]:
        error = refused(MAZE, f"++{section}._target_='{target}'", "++hydra.mode=RUN")
        assert f"{section}._target_={target}" in error
    value = f"{{_target_: '{target}', command: touch {CANARY}, args: [x]}}"
    assert "hydra.callbacks.x" in refused("-m", MAZE, f"++hydra.callbacks.x={value}")


LAUNCHER = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
SUBMITIT = "hydra_plugins.hydra_submitit_launcher.submitit_launcher.LocalLauncher"
LOG = "hydra/job_logging=default"
CALL = "{_target_: os.system, command: touch canary}"
BAD = {
    "outside hydra": [f"+x={CALL}"],
    "in an environment": [f"+env.x={CALL}"],
    "in a list": [f"+env.x=[[{CALL}]]"],
    "in Hydra's other keys": [f"+hydra.job.x={CALL}"],
    "nested in a launcher": [f"+hydra.launcher.x={CALL}"],
    "nested in a sweeper": [f"+hydra.sweeper.x={CALL}"],
    "in a list of a callback": [f"+hydra.callbacks.x={{y: [{CALL}]}}"],
    "arguments by position": ["+hydra.launcher._args_=[1]"],
    "partial": ["+hydra.launcher._partial_=true"],
    "not recursive": ["+hydra.sweeper._recursive_=false"],
    "converted": ["+env._convert_=all"],
    "a launcher's section": ["hydra.launcher=null"],
    "a sweeper's section": ["~hydra.sweeper._target_"],
    "a target by reference": ["hydra.launcher._target_=${oc.env:HOME}"],
    "a callback by reference": ["+hydra.callbacks.x=${env}"],
    "made from text": ["+hydra.callbacks.x='${oc.create:{_target_: os.system}}'"],
    "decoded": ["+hydra.callbacks.x='${oc.decode:${oc.env:X}}'"],
    "a resolver by reference": ["tag='${${tag}:x}'"],
    "selected": ["tag='${oc.select:runs_dir}'"],
    "given twice": [f"+hydra.callbacks={{x: {CALL}}}", "+hydra.callbacks={y: null}"],
    "commands of a launcher": [
        f"hydra.launcher._target_={SUBMITIT}",
        "+hydra.launcher.setup=['touch canary']",
    ],
    "a folder of a launcher": [
        f"hydra.launcher._target_={SUBMITIT}",
        "+hydra.launcher.submitit_folder=../x",
    ],
    "Hydra's sweep over experiments": [
        *("-m", "experiment=fig1,fig1_released", "scale=smoke", "hydra.sweep.dir=x"),
    ],
    "a shell's characters": [
        f"hydra.launcher._target_={SUBMITIT}",
        "+hydra.launcher.comment='$(touch canary)'",
    ],
    "a logging class": [LOG, "hydra.job_logging.handlers.file.class=os.system"],
    "a handler": [
        LOG,
        "hydra.job_logging.handlers.file.class=logging.handlers.QueueHandler",
    ],
    "a formatter": [LOG, "+hydra.job_logging.formatters.simple.class=subprocess.Popen"],
    "a stream": [LOG, "hydra.job_logging.handlers.console.stream=ext://os.system"],
    "an import": [LOG, "hydra.job_logging.formatters.simple.format=ext://antigravity"],
    "a filter": [LOG, "+hydra.job_logging.filters={x: {name: y}}"],
    "a logger's filter": [LOG, "+hydra.job_logging.root.filters=[x]"],
    "a level": [LOG, "hydra.job_logging.root.level=LOUD"],
    "a handler that is none": [LOG, "hydra.job_logging.root.handlers=[nope]"],
    "a log elsewhere": [LOG, "hydra.job_logging.handlers.file.filename=../x.log"],
    "a log where a shell reads": [
        LOG,
        "hydra.job_logging.handlers.file.filename=/tmp/.bashrc",
    ],
    "a log over our code": [LOG, "hydra.job_logging.handlers.file.filename=Makefile"],
    "a config over ours": ["hydra.run.dir=.", "hydra.output_subdir=conf"],
    "a job's name": [LOG, "hydra.job.name=../x"],
    "a log's section": [LOG, "hydra.job_logging.handlers=${env}"],
    "a logger by reference": [LOG, "hydra.job_logging.handlers.file=${env.tasks}"],
    "verbose": ["hydra.verbose={a: 1}"],
    "PATH": ["+hydra.job.env_set.PATH=/tmp"],
    "LD_PRELOAD": ["+hydra.job.env_set.LD_PRELOAD=evil.so"],
    "PYTHONPATH": ["+hydra.job.env_set={PYTHONPATH: /tmp}"],
    "BCRL_TRUST": ["+hydra.job.env_set.BCRL_TRUST=os"],
    "copied": ["hydra.job.env_copy=[PATH]"],
    "a package of configs": ["hydra.searchpath=[pkg://antigravity]"],
    "an environment's module": ["++env.name=os.path"],
    "a module beside ours": ["++env.name=../../os"],
    "an algorithm's module": ["++algorithm.name=os"],
    "a regressor's class": ["++algorithm.regressor.name=os.system"],
    "a cycle": ["tag=${device}", "device=${tag}"],
    "a cycle of sections": ["+env.x=${env}"],
    "home": ["runs_dir='~/x'"],
    "home, bare": ["runs_dir=~/x"],
    "a URL": ["runs_dir=file://x"],
    "a long name": ["runs_dir=" + "x" * 300],
    "a long tag": ["tag=" + "x" * 300],
    "a long path": ["runs_dir=" + "x/" * 1500],
    "a line break": ["runs_dir='a\nb'"],
    "NUL": ["runs_dir='a\0b'"],
    "a surrogate": ["runs_dir=a\udcff"],
    "run.dir": ["hydra.run.dir=../x"],
    "sweep.dir": ["hydra.sweep.dir=../x"],
    "sweep.subdir": ["hydra.sweep.subdir=../../x"],
    "output_subdir": ["hydra.output_subdir=../x"],
    "an option above": ["experiment=../../x"],
    "brackets": ["tag=" + "[" * 2000],
    "braces": ["+x=" + "{a:" * 2000],
    "calls": ["seeds.count=" + "int(" * 500],
    "keys": ["+" + "a." * 3000 + "a=1"],
    "length": ["env.metrics=[" + "a," * 20000 + "a]"],
    "a huge sweep": ["-m", "seeds.first=range(0,1000000000)"],
    "an endless sweep": ["-m", "seeds.first=range(0,inf)"],
    "a sweep of none": ["-m", "seeds.first=range(5,5)"],
    "a huge product": ["-m", *(f"+{k}=range(0,100)" for k in "abcd")],
    "huge seeds": ["seeds.count=999999999999"],
    "more digits than Python reads": ["seeds.first=1" + "0" * 5000],
}


@pytest.mark.parametrize("case", BAD)
def test_a_command_line_that_could_do_harm_is_refused(case, refused):
    refused(MAZE, *BAD[case])


def bomb(levels: int = 30) -> str:
    """Ten times ten times …: a few hundred bytes that mean 10^levels values."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    for i in range(1, levels):
        lines.append(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]")
    return "\n".join(lines) + "\n"


def growth(levels: int = 60) -> str:
    lines = ["a0: xxxxxxxxxx"]
    lines += [f"a{i}: ${{.a{i - 1}}}${{.a{i - 1}}}" for i in range(1, levels)]
    return "env:\n  x:\n" + "".join(f"    {line}\n" for line in lines)


YAMLS = {
    "a launcher": "hydra: {launcher: {_target_: os.system}}",
    "a sweeper": "hydra: {sweeper: {_target_: posix.system}}",
    "a callback": "hydra: {callbacks: {x: {_target_: os.system, command: touch x}}}",
    "a factory": """
        hydra:
          job_logging:
            handlers: {x: {(): os.system, command: touch canary}}
        """,
    "a formatter's factory": """
        hydra: {hydra_logging: {formatters: {x: {'()': os.system, command: touch x}}}}
        """,
    "a class": "hydra: {hydra_logging: {handlers: {x: {class: os.system}}}}",
    "a stream": "hydra: {job_logging: {handlers: {x: {stream: ext://os.system}}}}",
    "a config's part": "hydra: {job_logging: {handlers: {x: {stream: cfg://root}}}}",
    "an own searchpath": "hydra: {searchpath: ['pkg://antigravity']}",
    "an object": "tag: !!python/object/apply:os.system ['touch canary']",
    "a name": "tag: !!python/name:os.system",
    "a path": "tag: !!python/object/apply:pathlib.Path [x]",
    "bytes": "tag: !!binary aGk=",
    "a tag of one's own": "tag: !mine x",
    "many laughs": bomb(),
    "laughs by merging": bomb(9) + "b: {<<: [*a8, *a8]}",
    "itself": "a: &a [*a]",
    "nesting": "a: " + "[" * 3000 + "]" * 3000,
    "nesting by aliases": "a0: &a0 [x]\n"
    + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 500)),
    "much": "a: [" + "1," * 100_000 + "1]",
    "large": "# " + "x" * 2_000_000,
    "growing text": growth(),
    "a long chain": "env:\n  x: {a0: x"
    + "".join(f", a{i}: '${{.a{i - 1}}}'" for i in range(1, 500))
    + "}",
    "a package too deep": "# @package " + "a." * 400 + "a\nx: 1",
    "no mapping": "[1, 2]",
    "a folder outside": "runs_dir: ../x",
    "a folder outside, deeper": "runs_dir: a/../../x",
    "two documents": "a: 1\n---\nb: 2",
    "a date's key": "2020-01-01: 1",
    "a null key": "env: {null: 1, 3: {_target_: os.system}}",
}


@pytest.mark.parametrize("case", YAMLS)
def test_a_config_of_ones_own_that_could_do_harm_is_refused_soon(
    case, refused, tmp_path
):
    option = own(tmp_path, YAMLS[case])
    plans(MAZE)  # what is loaded once isn't to be timed
    began = time.perf_counter()
    refused(MAZE, "experiment=mine", option)
    assert time.perf_counter() - began < 3


def test_a_file_that_is_not_utf8_or_leads_in_circles_is_refused(refused, tmp_path):
    option = own(tmp_path, "tag: x")
    place = tmp_path / "own" / "experiment"
    (place / "mine.yaml").write_bytes(b"# @package _global_\ntag: '\xff\xfe'\n")
    assert "mine.yaml isn't UTF-8" in refused(MAZE, "experiment=mine", option)
    (place / "loop").symlink_to(place)
    (place / "self.yaml").symlink_to(place / "self.yaml")
    os.mkfifo(place / "pipe.yaml")
    refused(MAZE, "experiment=self", option)
    refused(MAZE, "experiment=pipe", option)
    refused(MAZE, "experiment=" + "loop/" * 60 + "nope", option)


@pytest.mark.parametrize(
    "shown", [[], ["--info"], ["--cfg", "all"], ["--info", "defaults"], ["--dry-run"]]
)
def test_a_primary_config_of_ones_own_is_checked_whatever_is_asked(
    shown, refused, tmp_path
):
    base = "defaults: [config, _self_]\n"
    for text in (
        base + "hydra: {searchpath: ['pkg://antigravity']}",
        base + "hydra: {hydra_logging: {version: 1, root: {}, filters: {}}}",
        base + bomb(),
    ):
        option = own(tmp_path, text, "primary")
        refused(MAZE, "--config-name=primary", option, *shown)


def test_completion_reads_no_package_and_no_bomb(refused, tmp_path, monkeypatch):
    own(tmp_path, bomb(), "experiment/mine")
    for entry in ("pkg://antigravity", str(tmp_path / "own")):
        line = f"bcrl {MAZE} hydra.searchpath=[{entry}] experiment=mine tag"
        monkeypatch.setenv("COMP_LINE", line)
        refused("-sc", "query=bash")


@pytest.mark.parametrize("arguments", [["--cfg=job", "env=maz"], ["-sc", "install=sh"]])
def test_showing_something_ends_in_a_message_too(arguments, refused):
    refused(*arguments)


@pytest.mark.parametrize("kind", ["hydra_logging", "job_logging"])
@pytest.mark.parametrize("option", ["default", "disabled", "none", "stdout"])
def test_hydras_own_options_are_allowed(kind, option):
    if (kind, option) == ("hydra_logging", "stdout"):
        option = "hydra_debug"
    assert plan(MAZE, f"hydra/{kind}={option}")


def test_absolute_folders_are_allowed(tmp_path):
    assert plan(MAZE, f"runs_dir={tmp_path}/../x").root == tmp_path / ".." / "x"
    assert plan(MAZE, "runs_dir=a/b").root == Path("a/b")


def test_a_folder_that_is_typed_may_lie_outside(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for typed in ("../x", "a/../../x", "'../x'", '"../x"'):
        assert plan(MAZE, f"runs_dir={typed}").root == tmp_path / "x"
    swept = plans(MAZE, "runs_dir=../x,../y", "seeds=1", multirun=True)
    assert [p.root.name for p in swept] == ["x", "y"]


def test_threads_may_be_set():
    assert plan(MAZE, "+hydra.job.env_set.OMP_NUM_THREADS=1")


def test_the_command_itself_runs_nothing_of_a_malicious_config(bcrl, tmp_path):
    option = own(tmp_path, YAMLS["a callback"].replace("touch x", "touch canary"))
    for arguments in (
        [MAZE, "experiment=mine", option],
        [MAZE, "experiment=mine", option, "--cfg=job"],
        ["-m", MAZE, "curriculum=on,off", "hydra.launcher._target_=os.system"],
        [MAZE, *BAD["given twice"]],
        [MAZE, "tag=\udcff"],
    ):
        done = bcrl(*arguments)
        assert done.returncode == 2, done.stderr
        assert done.stderr.startswith("bcrl: ") and "Traceback" not in done.stderr
        assert [path.name for path in tmp_path.iterdir()] == ["own"]


ENV = """
    # The maze's file is ours; this one is not.
    from dataclasses import dataclass

    from bcrl.envs.maze import ENV as Maze
    from bcrl.q.regressors import Tabular


    @dataclass(frozen=True)
    class ENV(Maze):
        name = "my_maze"


    @dataclass(frozen=True)
    class Mean(Tabular):
        least: int = 0


    class NoData:
        pass


    def method():
        import os
        os.system("touch canary")
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package `zoo` of the user's, with an environment and a regressor in it."""
    folder = tmp_path / "code" / "zoo"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text("")
    (folder / "broken.py").write_text("import no_such_module")
    (folder / "mazes.py").write_text(textwrap.dedent(ENV))
    monkeypatch.syspath_prepend(str(tmp_path / "code"))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "code"), prepend=os.pathsep)
    yield folder
    for name in [n for n in sys.modules if n.split(".")[0] == "zoo"]:
        del sys.modules[name]


def test_trusted_modules_add_an_environment_and_a_regressor(
    package, bcrl, tmp_path, monkeypatch
):
    maze = (Path(__file__).parents[2] / "conf/env/maze.yaml").read_text()
    text = maze.replace("name: maze", "name: zoo.mazes")
    option = own(tmp_path, text.replace("q_error, ", ""), "env/zoo")
    own(tmp_path, "name: zoo.mazes.Mean\nleast: 1\n", "algorithm/regressor/mean")
    arguments = ["env=zoo", "algorithm/regressor=mean", "scale=smoke", option]
    arguments += ["seeds.count=2", "workers=2", "env.metrics=[return]"]
    done = bcrl(*arguments)
    assert done.returncode == 2 and "BCRL_TRUST=zoo" in done.stderr
    monkeypatch.setenv(plugins.VARIABLE, "other, zoo.mazes")
    done = bcrl(*arguments)
    assert done.returncode == 0, done.stderr
    assert len(list((tmp_path / "runs/smoke/zoo").glob("*/seed_000?.csv"))) == 2


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("++env.name=zoo.", "isn't the name"),
        ("++env.name=zoo.broken", "can't be imported: ModuleNotFoundError"),
        ("++env.name=zoo.nope", "can't be imported"),
        ("++algorithm.name=zoo.mazes", "has no FAMILY"),
        ("++algorithm.regressor.name=zoo.mazes.nope", "has no nope"),
        ("++algorithm.regressor.name=zoo.mazes.NoData", "dataclass"),
        ("++env.name=zoological.garden", "isn't of this package"),
        ("+hydra.callbacks.x._target_=zoo.mazes.os.system", "can't be imported"),
        ("+hydra.callbacks.x._target_=zoo.mazes.dataclass", "isn't registered"),
        ("+hydra.callbacks.x._target_=zooo.mazes.method", "isn't registered"),
    ],
)
def test_what_a_trusted_module_lacks_is_said(package, monkeypatch, override, words):
    monkeypatch.setenv(plugins.VARIABLE, "zoo")
    with pytest.raises(BcrlError, match=words):
        plans(MAZE, override)


def test_a_trusted_callback_may_be_named(package, monkeypatch):
    monkeypatch.setenv(plugins.VARIABLE, "zoo")
    assert plans(MAZE, "+hydra.callbacks.x={_target_: zoo.mazes.NoData, y: 1}")


def test_limits_let_ordinary_yaml_pass():
    bounds.check_yaml("a: &a {x: [1, 2]}\nb: *a\nc: {<<: *a, y: !!str 3}\n")
    bounds.check_interpolations({"a": "${b}", "b": "${.c}${oc.env:HOME}", "c": "x"})


def test_nothing_that_is_read_as_data_can_be_a_pickle():
    banned = {"pickle", "cPickle", "dill", "cloudpickle", "shelve", "marshal", "joblib"}
    for path in Path(bcrl.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                assert not banned & {a.name.split(".")[0] for a in node.names}, path
            elif isinstance(node, ast.ImportFrom):
                assert (node.module or "").split(".")[0] not in banned, path
            elif isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                words = ast.unparse(node)
                assert called not in ("eval", "exec", "yaml.load", "__import__"), path
                if called in ("np.load", "numpy.load"):
                    assert "allow_pickle=False" in words, path
                if called == "torch.load":
                    assert "weights_only=True" in words, path
