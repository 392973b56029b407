"""Live logging: it sees what the CSVs hold, once, and changes nothing."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from bcrl.common.signals import Interrupted
from bcrl.errors import ConfigError
from bcrl.results import loggers
from bcrl.results.integrity import check_tree
from bcrl.results.layout import LOGS, seed_path
from bcrl.run import job, runner
from tests.conftest import plan

BC = ("env=maze", "variant=BC", "scale=smoke", "seeds.count=2", "progress=none")
MAZE = "maze/BC-FQI"
MODULE = """
import json
from dataclasses import dataclass

@dataclass(frozen=True)
class Lines:
    file: str = "rows"

    def open(self, runs_dir, run):
        return Writer(open(f"{self.file}-{run.replace('/', '-')}", "a"))

@dataclass(frozen=True)
class Writer:
    stream: object

    def write(self, count, row):
        print(json.dumps({"count": count, **row}), file=self.stream)

    def close(self):
        self.stream.close()
"""


def logged(root: Path, seed: int, folder: str = MAZE) -> dict:
    """Name of a metric → its (step, value) in the event files."""
    run = root / LOGS / "smoke" / folder / f"seed_{seed:04d}"
    events = EventAccumulator(str(run), {"scalars": 0}).Reload()
    names = events.Tags()["scalars"]
    return {n: [(e.step, e.value) for e in events.Scalars(n)] for n in names}


def check(root: Path, seed: int, folder: str = MAZE) -> None:
    """Assert that the event files hold a seed's finished CSV, each row once."""
    table = pd.read_csv(seed_path(root / "smoke" / folder, seed, "csv"))
    count = "step" if "step" in table else "iteration"
    found = logged(root, seed, folder)
    for name in table.columns.drop(count):
        finite = table[np.isfinite(table[name])]
        steps, values = (
            zip(*found.pop(name, ()), strict=True) if len(finite) else ((),) * 2
        )
        assert list(steps) == finite[count].tolist()
        np.testing.assert_array_equal(values, finite[name].to_numpy(np.float32))
    assert not found


def run(root: Path, *overrides: str) -> None:
    runner.run(plan(*overrides, f"runs_dir={root}"))


@pytest.mark.slow
def test_the_same_bytes_with_and_without(tmp_path):
    """One logged by two processes, one not: equal results, and a log of each seed."""
    plain, log = tmp_path / "plain", tmp_path / "logged"
    run(plain, *BC)
    run(log, *BC, "logger=tensorboard", "workers=2")
    for seed in (0, 1):
        for suffix in ("csv", "npz"):
            path = seed_path(Path("smoke") / MAZE, seed, suffix)
            assert (plain / path).read_bytes() == (log / path).read_bytes()
        check(log, seed)
    assert not (plain / LOGS).exists()
    variants, findings = check_tree(log)
    assert (len(variants), findings) == (1, [])


@pytest.mark.slow
def test_steps_are_logged_and_gaps_left_out(tmp_path):
    dqn = ("env=linear_system", "algorithm=dqn", "variant=BC", "scale=smoke")
    run(tmp_path, *dqn, "seeds.count=1", "progress=none", "logger=tensorboard")
    table = pd.read_csv(tmp_path / "smoke/linear_system/BC-DQN/seed_0000.csv")
    assert table["loss"].isna().any()
    check(tmp_path, 0, "linear_system/BC-DQN")


def test_an_interrupted_run_logs_nothing_twice(tmp_path, monkeypatch):
    """Stopped after a while, resumed in a new event file."""
    measure, train, seen, stops = job._Training.measure, job.train, [], []

    def counted(training, snapshot):
        measure(training, snapshot)
        seen.append(snapshot.count)
        if len(seen) == 7:
            stops[0].requested = True

    def stoppable(job, tick, stop):
        stops.append(stop)
        return train(job, tick, stop)

    monkeypatch.setattr(job._Training, "measure", counted)
    monkeypatch.setattr(job, "train", stoppable)
    with pytest.raises(Interrupted):
        run(tmp_path, *BC, "logger=tensorboard")
    assert [step for step, _ in logged(tmp_path, 1)["return"]] == list(range(1, 8))
    run(tmp_path, *BC, "logger=tensorboard")
    assert seen == list(range(1, 21))
    assert len(list((tmp_path / LOGS / "smoke" / MAZE / "seed_0001").iterdir())) == 2
    for seed in (0, 1):
        check(tmp_path, seed)


def test_a_missing_package_is_named_before_work_starts(tmp_path, monkeypatch):
    monkeypatch.setattr(loggers.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError) as rejected:
        loggers.logger({"name": "tensorboard"})
    assert (rejected.value.key, rejected.value.value) == ("logger", "tensorboard")
    assert "pip install" in rejected.value.allowed


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ({"name": None}, "logger", {"name": None}),
        ({"name": "tensorbord"}, "logger.name", "tensorbord"),
        ({"name": "none", "folder": "x"}, "logger.folder", "x"),
        ({"name": "os.System"}, "logger.name", "os.System"),
    ],
)
def test_bad_input_is_rejected(section, key, value):
    with pytest.raises(ConfigError) as rejected:
        loggers.logger(section)
    assert (rejected.value.key, rejected.value.value) == (key, value)


def test_a_users_logger(tmp_path, monkeypatch):
    """One module and one YAML, which has a setting."""
    (tmp_path / "my_loggers.py").write_text(MODULE)
    (tmp_path / "conf/logger").mkdir(parents=True)
    text = f"name: my_loggers.Lines\nfile: {tmp_path}/out\n"
    (tmp_path / "conf/logger/lines.yaml").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("BCRL_TRUST", "my_loggers")
    monkeypatch.delitem(sys.modules, "my_loggers", raising=False)
    run(tmp_path, *BC, "logger=lines", f"hydra.searchpath=[{tmp_path}/conf]")
    lines = pd.read_json(tmp_path / "out-smoke-maze-BC-FQI-seed_0001", lines=True)
    table = pd.read_csv(tmp_path / "smoke/maze/BC-FQI/seed_0001.csv")
    assert lines["count"].tolist() == table["iteration"].tolist()
    assert lines["return"].to_numpy() == pytest.approx(table["return"].to_numpy())
