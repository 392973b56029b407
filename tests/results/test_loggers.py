"""Loggers see what the CSVs hold, once, and change nothing (docs/howto/look.md)."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from bcrl.common.signals import Interrupted
from bcrl.errors import ConfigError
from bcrl.results import loggers
from bcrl.results.integrity import check_tree
from bcrl.results.layout import LOGS, seed_path
from bcrl.run import runner, sending
from tests.conftest import arguments, plan
from tests.run.runs import KINDS, MAZE, TABULAR, about, at_row, results, rows, run

#: CI sets this, so that a missing package is a failure there.
REQUIRED = os.environ.get("BCRL_LOGGERS") == "required"


def marks(name: str) -> list:
    """Of a test that needs a logger's package, and seconds to import it."""
    lacks = not (REQUIRED or importlib.util.find_spec(name))
    why = f"{name} isn't installed: the extra `{name}` has it"
    return [pytest.mark.skipif(lacks, reason=why), pytest.mark.slow]


OTHERS = [pytest.param(name, marks=marks(name)) for name in ("wandb", "mlflow")]
Points = dict[str, list[tuple[int, float]]]


def logged(made, seed: int, name: str) -> tuple[Points, dict]:
    """Each metric's (step, value), and what else a seed's log says, by its client."""
    root = Path(made.config["runs_dir"])
    run_name = f"{made.directory.relative_to(root).as_posix()}/seed_{seed:04d}"
    return {"wandb": of_wandb, "mlflow": of_mlflow}[name](root, run_name)


def of_tensorboard(folder: Path) -> Points:
    from tensorboard.backend.event_processing import event_accumulator

    events = event_accumulator.EventAccumulator(str(folder), {"scalars": 0}).Reload()
    names = events.Tags()["scalars"]
    return {n: [(e.step, e.value) for e in events.Scalars(n)] for n in names}


def of_wandb(root: Path, run_name: str) -> tuple[Points, dict]:
    """By `wandb leet inspect`; there must be one offline run of this name."""
    found = []
    for folder in (root / ".wandb").glob("offline-run-*"):
        command = [sys.executable, "-m", "wandb", "leet", "inspect", "--json", folder]
        text = subprocess.run(command, capture_output=True, check=True, text=True)
        records = [json.loads(line) for line in text.stdout.splitlines()]
        (about,) = (each["run"] for each in records if each["type"] == "run")
        if about["display_name"] == run_name:
            found.append((records, about))
    ((records, about),) = found
    points: Points = {}
    for item in (each["history"]["item"] for each in records if "history" in each):
        row = {key: value for key, value in item.items() if key[0] != "_"}
        count = row.pop("step" if "step" in row else "iteration")
        for key, value in row.items():
            points.setdefault(key, []).append((count, value))
    summaries = [each["summary"]["update"] for each in records if "summary" in each]
    ends = {key: value for each in summaries for key, value in each.items()}
    codes = [each["exit"].get("exit_code", 0) for each in records if "exit" in each]
    about |= {"settings": about["config"]["update"], "facts": ends, "ended": codes}
    return points, about | {"id": about["run_id"]}


def of_mlflow(root: Path, run_name: str) -> tuple[Points, dict]:
    """By MlflowClient; there must be one run of this name."""
    from mlflow import MlflowClient

    client = MlflowClient(f"sqlite:///{root}/.mlflow/mlflow.db")
    experiment = client.get_experiment_by_name("bcrl").experiment_id
    (found,) = client.search_runs([experiment], f"run_name = '{run_name}'")
    points = {}
    for name in found.data.metrics:
        history = client.get_metric_history(found.info.run_id, name)
        points[name] = [(metric.step, metric.value) for metric in history]
    codes = {"FINISHED": [0], "FAILED": [1]}.get(found.info.status, [])
    about = {"id": found.info.run_id, "settings": found.data.params, "ended": codes}
    return points, about | {"facts": found.data.tags}


def expected(made, seed: int) -> Points:
    """A seed's CSV, without NaN."""
    points: Points = {}
    for row in rows(made, seed):
        count = row.pop("step" if "step" in row else "iteration")
        for name, value in row.items():
            if np.isfinite(value):
                points.setdefault(name, []).append((count, value))
    return points


def check(made, name: str) -> None:
    """Assert that logs hold each seed's CSV, each row once, its settings and end."""
    for seed in made.seeds:
        right = expected(made, seed)
        if name == "tensorboard":  # it has 32 bits per number
            root = Path(made.config["runs_dir"])
            folder = root / LOGS / made.directory.relative_to(root) / f"seed_{seed:04d}"
            for pairs in right.values():
                pairs[:] = [(count, float(np.float32(value))) for count, value in pairs]
            assert of_tensorboard(folder) == right
            continue
        points, log = logged(made, seed, name)
        assert {k: sorted(v) for k, v in points.items()} == {
            k: sorted(v) for k, v in right.items()
        }
        assert log["ended"] == [0]
        assert str(log["settings"]["seed"]) == str(seed)
        assert log["settings"]["env.name"] == made.config["env"]["name"]
        document = about(made, seed)
        for key in ("status", "wall_seconds", "cpu_seconds"):
            assert str(log["facts"][key]) == str(document[key])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["maze BC", "dqn BC"])
@pytest.mark.parametrize("name", ["tensorboard", *OTHERS])
def test_the_same_bytes_with_and_without(tmp_path, kind, name):
    """One logged by two processes, one not: equal results, and a log of each seed."""
    plain = run(tmp_path / "plain", *KINDS[kind])
    two = ("workers=2", "seeds.lockstep=1")
    log = run(tmp_path / "log", *KINDS[kind], f"logger={name}", *two)
    for seed in (0, 1):
        assert results(plain, seed) == results(log, seed)
    check(log, name)
    assert [path.name for path in (tmp_path / "plain").iterdir()] == ["smoke"]
    variants, findings = check_tree(tmp_path / "log")
    assert (len(variants), findings) == (1, [])


def test_an_interrupted_run_logs_nothing_twice(tmp_path, monkeypatch):
    """Stopped after a while, resumed in a new event file."""
    seen = at_row(monkeypatch, 13, lambda: signal.raise_signal(signal.SIGTERM))
    words = (tmp_path, *MAZE, "logger=tensorboard")
    with pytest.raises(Interrupted):
        run(*words)
    assert seen == sorted([*range(1, 8)] * 2)
    made = run(*words)
    assert seen[14:] == [*range(1, 8)] * 2 + sorted([*range(8, 21)] * 2)
    folder = tmp_path / LOGS / "smoke/maze/BC-FQI/seed_0001"
    assert len(list(folder.iterdir())) == 2
    check(made, "tensorboard")


KILLED = """if True:
    import os, sys
    from bcrl.cli import main
    from bcrl.results import loggers
    from bcrl.results.loggers import mlflow

    def write(*row):
        before(*row)
        rows.append(row)
        if len(rows) == 29:
            os.kill(os.getpid(), 9)

    before, loggers.write, rows, mlflow.SECONDS = loggers.write, write, [], 0.0
    sys.argv[0] = "bcrl"
    main()
"""


@pytest.mark.parametrize("name", OTHERS)
def test_a_killed_run_goes_on_in_the_same_run_of_the_client(tmp_path, name):
    words = [*MAZE, f"logger={name}", f"runs_dir={tmp_path}", "checkpoint_every=0.001"]
    killed = subprocess.run([sys.executable, "-c", KILLED, *words])
    assert killed.returncode == -signal.SIGKILL
    p = plan(*words)
    points, log = logged(p, 0, name)
    assert len(points["return"]) in range(12, 16) and log["ended"] == []
    runner.run(p)
    assert logged(p, 0, name)[1]["id"] == log["id"]
    check(p, name)


@pytest.mark.parametrize("name", OTHERS)
def test_complete_seeds_are_sent_once_if_sent_twice(tmp_path, name):
    made = run(tmp_path, *TABULAR)
    words = (f"runs_dir={tmp_path}", f"logger={name}")
    sending.send(arguments(*words))
    sending.send(arguments(*TABULAR, *words))
    check(made, name)


@pytest.mark.parametrize("name", OTHERS[1:])
def test_mlflow_gets_what_it_lacks_and_a_new_run_for_other_values(tmp_path, name):
    made = plan(*TABULAR, f"runs_dir={tmp_path}")
    run_ = loggers.run_of(made.directory, 0, "iteration", made.config)

    def write(length: int, value: float) -> None:
        writer = loggers.MLflow("bcrl", None).open(run_)
        for count in range(1, length + 1):
            writer.write(count, {"return": value * count, "loss": np.nan})
        writer.close()

    for length in (3, 5, 2):
        write(length, 0.1)
    points, log = logged(made, 0, name)
    assert points == {"return": [(count, 0.1 * count) for count in range(1, 6)]}
    assert log["ended"] == []  # it was not finished
    write(4, 0.2)
    with pytest.raises(ValueError, match="too many values"):
        logged(made, 0, name)  # there are two runs of this name


NOTES: list[tuple] = []


@dataclass(frozen=True)
class Notes(loggers.Logger):
    """Notes what it is given, and fails with seed 1 in one step."""

    fails: str = ""

    def open(self, run: loggers.Run) -> loggers.Writer:
        writer = NotesOfSeed(self.fails, run.tags["seed"])
        writer.note("open", run)
        return writer


class NotesOfSeed(loggers.Writer):
    def __init__(self, fails: str, seed: int) -> None:
        self.fails, self.seed = fails, seed

    def note(self, step: str, *values) -> None:
        NOTES.append((self.seed, step, *values))
        if (self.seed, step) == (1, self.fails):
            raise OSError("no room")

    def write(self, count, row):
        self.note("write", count, row)

    def finish(self, facts):
        self.note("finish", facts)

    def close(self):
        self.note("close")


@pytest.fixture
def notes(monkeypatch):
    monkeypatch.setitem(loggers.LOGGERS, "notes", Notes)
    NOTES.clear()
    return NOTES


@pytest.mark.parametrize("step", ["open", "write", "finish", "close"])
def test_a_logger_that_fails_loses_no_run(tmp_path, capsys, notes, step):
    made = run(tmp_path, *TABULAR, "logger.name=notes", f"+logger.fails={step}")
    assert [about(made, seed)["status"] for seed in (0, 1)] == ["complete"] * 2
    assert capsys.readouterr().err.count(f"{made.directory}: the logger failed") == 1
    steps = {seed: [step for s, step, *_ in notes if s == seed] for seed in (0, 1)}
    assert steps[1].count(step) == 1 + (step == "close")
    assert steps[0][0] == "open" and "close" in steps[0]


def test_settings_tags_rows_and_ends_live_and_afterwards(tmp_path, notes):
    words = ("logger.name=notes", f"runs_dir={tmp_path}")
    made = run(tmp_path, *TABULAR, "tag=x", *words[:1])
    live = [[each[1:] for each in notes if each[0] == seed] for seed in (0, 1)]
    notes.clear()
    run(tmp_path, *TABULAR, "seeds.count=1", "tag=y")
    seed_path(made.directory, 1, "json").unlink()  # it is not complete now
    for asked, seeds in ((words, [0, 0]), ((*TABULAR, "tag=x", *words), [0])):
        notes.clear()
        sending.send(arguments(*asked))
        assert [each[0] for each in notes if each[1] == "open"] == seeds
        sent = [each[1:] for each in notes]
        assert sent[: len(live[0])] == live[0]
    (_, opened), *written, (_, facts), _ = live[0]
    assert opened.name == "smoke/maze/FQI@x/seed_0000" and opened.index == "iteration"
    tags = {"seed": 0, "scale": "smoke", "env": "maze", "variant": "FQI", "tag": "x"}
    assert (opened.tags, opened.config) == (tags, made.config)
    assert [row["return"] for *_, row in written] == [
        r["return"] for r in rows(made, 0)
    ]
    assert facts["status"] == "complete" and facts["wall_seconds"] > 0


def test_nothing_is_sent_without_a_logger(tmp_path):
    run(tmp_path, *TABULAR)
    with pytest.raises(ConfigError) as rejected:
        sending.send(arguments(f"runs_dir={tmp_path}"))
    assert (rejected.value.key, rejected.value.value) == ("logger", "none")


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ({"name": "tensorbord"}, "logger.name", "tensorbord"),
        ({"name": "none", "folder": "x"}, "logger.folder", "x"),
        ({"name": "os.System"}, "logger.name", "os.System"),
        ({"name": "tensorboard"}, "logger", "tensorboard"),  # not installed
        ({"name": "wandb", "project": "x"}, "logger", "wandb"),
        ({"name": "wandb", "project": None}, "logger.project", None),
        (
            {"name": "mlflow", "experiment": "x", "tracking_uri": None},
            "logger",
            "mlflow",
        ),
    ],
)
def test_bad_input_is_rejected_before_work_starts(monkeypatch, section, key, value):
    monkeypatch.setattr(loggers.base, "find_spec", lambda name: None)
    with pytest.raises(ConfigError) as rejected:
        loggers.logger(section)
    assert (rejected.value.key, rejected.value.value) == (key, value)
