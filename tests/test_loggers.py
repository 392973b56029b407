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
from bcrl.report.integrity import check_tree
from bcrl.results import loggers
from bcrl.run import runner
from tests.conftest import plan

BC = ("env=maze", "variant=BC", "scale=smoke", "seeds.count=2", "progress=none")
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


def logged(root: Path, seed: int, folder: str = "maze/BC-FQI") -> dict:
    """Name of a metric → its (step, value) in the event files."""
    run = root / loggers.FOLDER / "smoke" / folder / f"seed_{seed:04d}"
    events = EventAccumulator(str(run), {"scalars": 0}).Reload()
    names = events.Tags()["scalars"]
    return {n: [(e.step, e.value) for e in events.Scalars(n)] for n in names}


def check(root: Path, seed: int, folder: str = "maze/BC-FQI") -> None:
    """Assert that the event files hold a seed's finished CSV, each row once."""
    table = pd.read_csv(root / "smoke" / folder / f"seed_{seed:04d}.csv")
    count = "step" if "step" in table else "iteration"
    found = logged(root, seed, folder)
    for name in table.columns.drop(count):
        finite = table[np.isfinite(table[name])]
        if not len(finite):
            assert name not in found
            continue
        steps, values = zip(*found[name], strict=True)
        assert list(steps) == finite[count].tolist()
        np.testing.assert_array_equal(values, finite[name].to_numpy(np.float32))


def run(root: Path, *overrides: str) -> None:
    runner.run(plan(*overrides, f"runs_dir={root}"))


def test_the_same_bytes_with_and_without(tmp_path):
    """One logged by two processes, one not: equal results, and a log of each seed."""
    run(tmp_path / "plain", *BC)
    run(tmp_path / "logged", *BC, "logger=tensorboard", "workers=2")
    for seed in (0, 1):
        for suffix in ("csv", "npz"):
            path = f"smoke/maze/BC-FQI/seed_{seed:04d}.{suffix}"
            first, second = (
                (tmp_path / d / path).read_bytes() for d in ("plain", "logged")
            )
            assert first == second
        check(tmp_path / "logged", seed)
    assert not (tmp_path / "plain" / loggers.FOLDER).exists()
    variants, findings = check_tree(tmp_path / "logged")
    assert (len(variants), findings) == (1, [])


def test_steps_are_logged_and_gaps_left_out(tmp_path):
    dqn = ("env=linear_system", "algorithm=dqn", "variant=BC", "scale=smoke")
    run(tmp_path, *dqn, "seeds.count=1", "progress=none", "logger=tensorboard")
    table = pd.read_csv(tmp_path / "smoke/linear_system/BC-DQN/seed_0000.csv")
    assert table["loss"].isna().any()
    check(tmp_path, 0, "linear_system/BC-DQN")


def test_an_interrupted_run_logs_nothing_twice(tmp_path, monkeypatch):
    """Stopped after a while, gone on with in a new event file."""
    from bcrl.run import job as training

    look, seen = training._measure, []

    def counted(probe, now, session, log):
        look(probe, now, session, log)
        seen.append(now.count)
        if len(seen) == 7:
            stops[0].ask()

    stops = []
    train = training.train
    monkeypatch.setattr(training, "_look", counted)
    monkeypatch.setattr(
        training,
        "train",
        lambda job, tick, stop: stops.append(stop) or train(job, tick, stop),
    )
    arguments = (*BC, "logger=tensorboard")
    with pytest.raises(Interrupted):
        run(tmp_path, *arguments)
    assert [step for step, _ in logged(tmp_path, 1)["return"]] == list(range(1, 8))
    run(tmp_path, *arguments)
    assert seen == list(range(1, 21))
    folder = tmp_path / loggers.FOLDER / "smoke/maze/BC-FQI/seed_0001"
    assert len(list(folder.iterdir())) == 2
    for seed in (0, 1):
        check(tmp_path, seed)


def test_a_missing_package_is_said_before_work_starts(tmp_path, monkeypatch):
    find = loggers.importlib.util.find_spec
    monkeypatch.setattr(
        loggers.importlib.util,
        "find_spec",
        lambda name: None if name == "tensorboard" else find(name),
    )
    with pytest.raises(
        ConfigError, match=r"pip install 'boosted-curriculum-rl\[tensor"
    ):
        run(tmp_path / "runs", *BC, "logger=tensorboard")
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("logger.name=null", "must be a section with a name"),
        ("logger.name=tensorbord", "logger.name=tensorbord: did you mean tensorboard?"),
        ("+logger.folder=x", "logger.folder=x: unknown key"),
        ("logger.name=os.System", "os has no System"),
    ],
)
def test_bad_input_is_refused(tmp_path, override, message):
    with pytest.raises(ConfigError) as refused:
        run(tmp_path / "runs", *BC, override)
    assert message in str(refused.value)
    assert not (tmp_path / "runs").exists()


def test_a_logger_of_ones_own(tmp_path, monkeypatch):
    """One module and one YAML, with a setting of its own."""
    (tmp_path / "my_loggers.py").write_text(MODULE)
    (tmp_path / "conf/logger").mkdir(parents=True)
    text = f"name: my_loggers.Lines\nfile: {tmp_path}/out\n"
    (tmp_path / "conf/logger/lines.yaml").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("BCRL_TRUST", "my_loggers")
    monkeypatch.delitem(sys.modules, "my_loggers", raising=False)
    overrides = (*BC, "logger=lines", f"hydra.searchpath=[{tmp_path}/conf]")
    run(tmp_path / "runs", *overrides)
    lines = pd.read_json(tmp_path / "out-smoke-maze-BC-FQI-seed_0001", lines=True)
    table = pd.read_csv(tmp_path / "runs/smoke/maze/BC-FQI/seed_0001.csv")
    assert lines["count"].tolist() == table["iteration"].tolist()
    assert lines["return"].to_numpy() == pytest.approx(table["return"].to_numpy())
