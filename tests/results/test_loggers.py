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
from bcrl.results import layout, loggers
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
ALL = [pytest.param("tensorboard", marks=pytest.mark.slow), *OTHERS]
Points = dict[str, list[tuple[int, float]]]


def run_of(made, seed: int) -> loggers.Run:
    return loggers.run_of(
        made.directory, seed, layout.INDEX[made.family][-1], made.config
    )


def logged(made, seed: int, name: str) -> tuple[Points, dict]:
    """Each metric's (step, value), and what else a seed's log says, by its client."""
    return {"wandb": of_wandb, "mlflow": of_mlflow}[name](run_of(made, seed))


def of_tensorboard(folder: Path) -> Points:
    from tensorboard.backend.event_processing import event_accumulator

    events = event_accumulator.EventAccumulator(str(folder), {"scalars": 0}).Reload()
    names = events.Tags()["scalars"]
    return {n: [(e.step, e.value) for e in events.Scalars(n)] for n in names}


def of_wandb(run: loggers.Run) -> tuple[Points, dict]:
    """By `wandb leet inspect`."""
    (folder,) = (run.runs_dir / ".wandb").glob(f"offline-run-*-{run.id}")
    command = [sys.executable, "-m", "wandb", "leet", "inspect", "--json", folder]
    text = subprocess.run(command, env=alone(), capture_output=True, check=True).stdout
    records = [json.loads(line) for line in text.splitlines()]
    (about,) = (each["run"] for each in records if each["type"] == "run")
    assert about["display_name"] == run.name
    points: Points = {}
    for item in (each["history"]["item"] for each in records if "history" in each):
        row = {key: value for key, value in item.items() if key[0] != "_"}
        count = row.pop(run.index)
        for key, value in row.items():
            points.setdefault(key, []).append((count, value))
    summaries = [each["summary"]["update"] for each in records if "summary" in each]
    ends = {key: value for each in summaries for key, value in each.items()}
    codes = [each["exit"].get("exit_code", 0) for each in records if "exit" in each]
    settings = about["config"]["update"]
    return points, {"settings": settings, "facts": ends, "ended": codes}


def alone() -> dict[str, str]:
    """The environment of a process without the network and this one's service."""
    kept = {key: value for key, value in os.environ.items() if key != "WANDB_SERVICE"}
    return kept | {"WANDB_ERROR_REPORTING": "false"}


def of_mlflow(run: loggers.Run) -> tuple[Points, dict]:
    """By MlflowClient; there must be one run of this name."""
    client, runs = runs_of_mlflow(run.runs_dir)
    (found,) = (each for each in runs if each.info.run_name == run.name)
    points = {}
    for name in found.data.metrics:
        history = client.get_metric_history(found.info.run_id, name)
        points[name] = [(metric.step, metric.value) for metric in history]
    codes = {"FINISHED": [0], "FAILED": [1]}.get(found.info.status, [])
    settings, facts = found.data.params, found.data.tags
    return points, {"settings": settings, "facts": facts, "ended": codes}


def runs_of_mlflow(root: Path):
    from mlflow import MlflowClient

    client = MlflowClient(f"sqlite:///{root}/.mlflow/mlflow.db")
    experiment = client.get_experiment_by_name("bcrl")
    return client, client.search_runs([experiment.experiment_id])


def ids(root: Path, name: str) -> list[str]:
    """The ids of all runs in a client's folder."""
    if name == "mlflow":
        return sorted(run.info.run_id for run in runs_of_mlflow(root)[1])
    folders = (root / ".wandb").glob("offline-run-*")
    return sorted(folder.name.rpartition("-")[2] for folder in folders)


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
        if name == "mlflow":  # it has equal values of two stages' one step once
            right = {key: sorted(set(pairs)) for key, pairs in right.items()}
            points = {key: sorted(pairs) for key, pairs in points.items()}
        assert points == right
        assert log["ended"] == [0]
        assert str(log["settings"]["seed"]) == str(seed)
        assert log["settings"]["env.name"] == made.config["env"]["name"]
        document = about(made, seed)
        for key in ("status", "wall_seconds", "cpu_seconds"):
            assert str(log["facts"][key]) == str(document[key])


@pytest.mark.slow
def test_bytes_of_dqn_are_the_same_with_and_without(tmp_path):
    plain = run(tmp_path / "plain", *KINDS["dqn BC"])
    log = run(tmp_path / "log", *KINDS["dqn BC"], "logger=tensorboard", "workers=2")
    assert [results(plain, s) for s in (0, 1)] == [results(log, s) for s in (0, 1)]
    check(log, "tensorboard")


@pytest.mark.parametrize("name", ALL)
def test_the_same_bytes_with_and_without_and_seeds_sent_afterwards(tmp_path, name):
    """Logged by two processes, or not at all, or after training, or both."""
    plain = run(tmp_path / "plain", *MAZE)
    two = ("workers=2", "seeds.lockstep=1")
    log = run(tmp_path / "log", *MAZE, f"logger={name}", *two)
    assert [results(plain, s) for s in (0, 1)] == [results(log, s) for s in (0, 1)]
    assert [path.name for path in (tmp_path / "plain").iterdir()] == ["smoke"]
    check(log, name)
    later = run(tmp_path / "log", *TABULAR)
    sending.send(arguments(f"logger={name}", f"runs_dir={tmp_path / 'log'}"))
    check(log, name)
    check(later, name)
    variants, findings = check_tree(tmp_path / "log")
    assert (len(variants), findings) == (2, [])


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
    from bcrl.results import layout, loggers
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
    killed = subprocess.run([sys.executable, "-c", KILLED, *words], env=alone())
    assert killed.returncode == -signal.SIGKILL
    p, begun = plan(*words), ids(tmp_path, name)
    if name == "mlflow":  # wandb writes a file in larger blocks
        points, log = logged(p, 0, name)
        assert len(points["return"]) == 15 and log["ended"] == []
    runner.run(p)
    assert ids(tmp_path, name) == begun and len(begun) == 2
    check(p, name)


@pytest.mark.parametrize("name", OTHERS[1:])
def test_mlflow_gets_what_it_lacks_and_a_new_run_for_other_values(tmp_path, name):
    made = plan(*TABULAR, f"runs_dir={tmp_path}")

    def write(values: list[float]) -> None:
        writer = loggers.MLflow("bcrl", None).open(run_of(made, 0))
        for step, value in enumerate(values):
            # A step that ends a stage and begins the next one has two rows.
            writer.write(step // 2, {"return": value, "loss": np.nan})
        writer.close()

    values = [0.1, 0.7, 0.2, 0.6, 0.3, 0.5]
    for length in (3, 6, 2):
        write(values[:length])
    points, log = logged(made, 0, name)
    assert points == {"return": list(zip([0, 0, 1, 1, 2, 2], values, strict=True))}
    assert log["ended"] == [] and len(ids(tmp_path, name)) == 1
    write([0.1, 0.7, 0.9, 0.6, 0.3])
    assert len(ids(tmp_path, name)) == 2


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
