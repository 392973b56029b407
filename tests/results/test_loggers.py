"""Live logging: it sees what the CSVs hold, once, and changes nothing."""

import signal
from pathlib import Path

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from bcrl.common.signals import Interrupted
from bcrl.errors import ConfigError
from bcrl.results import loggers
from bcrl.results.integrity import check_tree
from bcrl.results.layout import LOGS
from tests.run.runs import KINDS, MAZE, results, rows, run


def logged(made, seed: int) -> dict[str, list[tuple[int, float]]]:
    """Name of a metric → its (step, value) in a seed's event files."""
    root = Path(made.config["runs_dir"])
    folder = root / LOGS / made.directory.relative_to(root) / f"seed_{seed:04d}"
    events = EventAccumulator(str(folder), {"scalars": 0}).Reload()
    names = events.Tags()["scalars"]
    return {n: [(e.step, e.value) for e in events.Scalars(n)] for n in names}


def check(made) -> None:
    """Assert that the event files hold each seed's CSV, each row once, without NaN."""
    for seed in made.seeds:
        expected = {}
        for row in rows(made, seed):
            count = row.pop("step" if "step" in row else "iteration")
            for name, value in row.items():
                if np.isfinite(value):
                    point = (count, float(np.float32(value)))
                    expected.setdefault(name, []).append(point)
        assert logged(made, seed) == expected


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["maze BC", "dqn BC"])
def test_the_same_bytes_with_and_without(tmp_path, kind):
    """One logged by two processes, one not: equal results, and a log of each seed."""
    plain = run(tmp_path / "plain", *KINDS[kind])
    log = run(tmp_path / "log", *KINDS[kind], "logger=tensorboard", "workers=2")
    for seed in (0, 1):
        assert results(plain, seed) == results(log, seed)
    check(log)
    assert not (tmp_path / "plain" / LOGS).exists()
    variants, findings = check_tree(tmp_path / "log")
    assert (len(variants), findings) == (1, [])


def test_an_interrupted_run_logs_nothing_twice(tmp_path, monkeypatch):
    """Stopped after a while, resumed in a new event file."""
    events = loggers.TensorBoard().open(tmp_path, "x")
    write, seen = type(events).write, []

    def counted(events, count, row):
        write(events, count, row)
        seen.append(count)
        if len(seen) == 13:  # of the two seeds
            signal.raise_signal(signal.SIGTERM)

    words = (tmp_path, *MAZE, "logger=tensorboard")
    monkeypatch.setattr(type(events), "write", counted)
    with pytest.raises(Interrupted):
        run(*words)
    assert seen == sorted([*range(1, 8)] * 2)
    made = run(*words)
    assert seen[14:] == [*range(1, 8)] * 2 + sorted([*range(8, 21)] * 2)
    folder = tmp_path / LOGS / "smoke/maze/BC-FQI/seed_0001"
    assert len(list(folder.iterdir())) == 2
    check(made)


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ({"name": "tensorbord"}, "logger.name", "tensorbord"),
        ({"name": "none", "folder": "x"}, "logger.folder", "x"),
        ({"name": "os.System"}, "logger.name", "os.System"),
        ({"name": "tensorboard"}, "logger", "tensorboard"),  # not installed
    ],
)
def test_bad_input_is_rejected_before_work_starts(monkeypatch, section, key, value):
    monkeypatch.setattr(loggers.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError) as rejected:
        loggers.logger(section)
    assert (rejected.value.key, rejected.value.value) == (key, value)
