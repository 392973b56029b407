"""Memory of jobs: what they allocate, and the rejection of what can't fit."""

import numpy as np
import pytest

from bcrl.errors import ConfigError
from bcrl.learning.replay import Replay
from bcrl.run import memory, runner
from bcrl.run.schedule import Failures, ordered
from tests.conftest import plan
from tests.run.runs import LINEAR


def test_the_estimate_is_that_of_the_replay_memory(tmp_path):
    words = (*LINEAR, "variant=plain", "algorithm.replay_size=1000", "scale=quick")
    (job,) = ordered([plan(*words, f"runs_dir={tmp_path}", "seeds=2")], Failures())
    env = job.plan.target
    replay = Replay.empty(2, 1000, env.state_dim, env.n_actions, "cpu")
    arrays = replay.rows.numpy(), replay.bootstrap, replay.valid
    assert replay.rows.numpy().dtype == np.float32
    size = sum(array.nbytes for array in arrays)
    assert memory.needed(job)["algorithm.replay_size"] == size
    assert memory.expected_bytes(job) > size


@pytest.mark.parametrize("algorithm", ["dqn", "fqi"])
@pytest.mark.parametrize("workers", [1, 2])
def test_what_cannot_fit_is_rejected_before_work(
    tmp_path, monkeypatch, algorithm, workers
):
    large = {"dqn": ("replay_size", 10**8), "fqi": ("episodes", 10**6)}
    key, value = large[algorithm]
    words = ["env=cart_pole", f"algorithm={algorithm}", f"algorithm.{key}={value}"]
    words += [
        f"workers={workers}",
        "seeds=2",
        "seeds.lockstep=1",
        f"runs_dir={tmp_path}",
    ]
    if algorithm == "dqn":
        words.append("algorithm.steps=100000000")
    p = plan(*words)
    job = ordered([p], Failures())[0]
    room = workers * memory.expected_bytes(job)
    monkeypatch.setattr(memory, "available", lambda: room)
    memory.check_fits(ordered([p], Failures()))
    monkeypatch.setattr(memory, "available", lambda: room / 100)
    with pytest.raises(ConfigError) as caught:
        runner.run(p)
    assert (caught.value.key, caught.value.value) == (f"algorithm.{key}", value)
    assert list(tmp_path.iterdir()) == []


def test_a_limit_of_the_cgroup_holds(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "_CGROUPS", tmp_path)
    whole = memory.available()
    (tmp_path / "memory.max").write_text("max\n")
    assert memory.available() == whole
    (tmp_path / "memory.max").write_text("4096\n")
    (tmp_path / "memory").mkdir()
    (tmp_path / "memory/memory.limit_in_bytes").write_text("4096\n")
    assert memory.available() == 4096
