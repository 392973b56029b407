"""Whole runs at smoke scale: their files, equal results in any grouping, failures."""

import hashlib
import io
import itertools
import json
import math
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from bcrl import api
from bcrl.errors import BcrlError, ConfigError
from bcrl.learning.fqi import FQI as Learner
from bcrl.learning.stage import SeedBatch, learn
from bcrl.results.read import read_csv
from bcrl.run import runner
from bcrl.run.records import is_complete, pending
from tests.conftest import plan
from tests.run.runs import (
    DQN,
    FQI,
    LINEAR,
    MAZE,
    METHODS,
    RELEASED,
    about,
    dqn,
    results,
    rows,
    run,
)

TABULAR = ("env=maze", *FQI, "algorithm/regressor=tabular")
FQI_COLUMNS = {
    "car_on_hill": "stage,task,iteration,q_error,return",
    "maze": "stage,task,iteration,return,q_error_start,q_error,residual_start,solved",
}
DQN_COLUMNS = (
    "stage,task,step,return,discounted_return,success_rate,q_mean,loss,"
    "greedy_return,greedy_discounted_return,greedy_success_rate"
)
KINDS = {
    f"{env} {name}": (f"env={env}", f"variant={name}", *FQI)
    for env, name in itertools.product(FQI_COLUMNS, ("plain", "C", "B", "BC"))
}
KINDS |= {f"dqn {name}": dqn(name) for name in METHODS + RELEASED}
FAST = ("maze BC", "car_on_hill C", "dqn SBC")


def kinds(*fast: str) -> list:
    """All kinds of runs as parameters; all but the fast ones are slow."""
    marks = {name: [] if name in fast else [pytest.mark.slow] for name in KINDS}
    return [pytest.param(name, marks=marks[name]) for name in KINDS]


@pytest.mark.parametrize("kind", kinds(*FAST))
def test_a_seed_is_the_same_alone_and_among_others(tmp_path, kind):
    alone = run(tmp_path / "a", *KINDS[kind], "seeds=[3]", "threads=1")
    among = run(tmp_path / "b", *KINDS[kind], "seeds=5", "threads=2")
    assert results(alone, 3) == results(among, 3)
    assert len({results(among, seed)[0] for seed in range(5)}) == 5  # seeds differ


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["maze C", "car_on_hill BC", "dqn BC"])
def test_a_seed_is_the_same_with_one_worker_and_with_two(tmp_path, kind):
    ways = [
        run(tmp_path / f"{workers}", *KINDS[kind], f"workers={workers}", "threads=1")
        for workers in (1, 2)
    ]
    for seed in (0, 1):
        assert results(ways[0], seed) == results(ways[1], seed)


@pytest.mark.parametrize("env", FQI_COLUMNS)
def test_the_files_of_an_fqi_run(tmp_path, env):
    p = run(tmp_path, f"env={env}", "variant=BC", *FQI)
    assert p.directory == tmp_path / "smoke" / env / "BC-FQI"
    names = {f"seed_000{s}.{x}" for s in (0, 1) for x in ("csv", "json", "npz")}
    assert {f.name for f in p.directory.iterdir()} == names | {"config.yaml"}
    assert results(p, 0)[0].decode().splitlines()[0] == FQI_COLUMNS[env]
    found = rows(p, 0)
    assert [r["iteration"] for r in found] == list(range(1, 2 * len(p.tasks) + 1))
    assert [r["task"] for r in found] == [i // 2 + 1 for i in range(len(found))]
    assert all(math.isfinite(value) for row in found for value in row.values())
    facts = about(p, 0)
    assert facts["status"] == "complete" and facts["variant"] == "BC-FQI"
    assert facts["config"]["env"]["name"] == env
    for key in ("versions", "git", "machine", "cpu_seconds", "wall_seconds"):
        assert facts[key]
    arrays = np.load(p.directory / "seed_0000.npz", allow_pickle=False)
    n, a = len(arrays["states"]), p.target.n_actions
    assert arrays["q"].shape == (n, a)
    assert arrays["residuals"].shape == (len(p.stages), n, a)
    # Q is the sum of the residuals: boosting's definition.
    assert np.allclose(arrays["residuals"].sum(0), arrays["q"], atol=1e-12)
    if env == "maze":
        assert facts["optimum"] == pytest.approx(-47.557563488, abs=1e-8)
        assert arrays["trajectory"][0].tolist() == [0.0, 0.0]
        assert arrays["walls"].shape == (10, 2, 4)


def test_the_files_of_a_dqn_run(tmp_path):
    p = run(tmp_path, *LINEAR, "variant=BC")
    assert p.directory == tmp_path / "smoke" / "linear_system" / "BC-DQN"
    text = results(p, 0)[0].decode()
    assert text.splitlines()[0] == DQN_COLUMNS
    found = rows(p, 0)
    assert [(r["stage"], r["task"], r["step"]) for r in found] == [
        *((1, 1, step) for step in (0, 500, 1000, 1500, 2000)),
        *((2, 2, step) for step in (2000, 2700)),
    ]
    assert all(math.isfinite(v) for r in found for k, v in r.items() if k != "loss")
    assert [math.isnan(r["loss"]) for r in found] == [True] * 6 + [False]
    assert "nan" not in text and text.splitlines()[1].split(",")[7] == ""
    document = about(p, 0)
    for form in (text, text.replace(",,", ",nan,")):  # now, and in older runs
        path = tmp_path / "seed_0000.csv"
        path.write_text(form)
        document["sha256"]["csv"] = hashlib.sha256(form.encode()).hexdigest()
        for table in (pd.read_csv(io.StringIO(form)), read_csv(path, document)):
            assert table["loss"].dtype == float and table["loss"].isna().sum() == 6
    assert api.read(p.directory)["loss"].dtype == float
    assert all(-150 <= r["return"] <= 0 for r in found[5:])
    assert document["status"] == "complete" and document["learners"] == ["lspi", "dqn"]
    arrays = np.load(p.directory / "seed_0000.npz", allow_pickle=False)
    assert arrays["q_stages"].shape == (2, 41 * 41, 8)
    assert np.array_equal(arrays["q"], arrays["q_stages"][-1])
    assert {"states", "actions", "pathway", "goal", "start", "drift"} <= set(arrays)


def test_dqn_counts_every_step_of_every_stage(tmp_path):
    p = run(tmp_path, *LINEAR, "variant=C", "algorithm.evaluation_episodes=3", "tag=x")
    steps = [(r["stage"], r["step"]) for r in rows(p, 0)]
    # 500 random steps, 700 in LQ (evaluated every 500), 700 in the target
    assert steps == [(1, 500), (1, 1000), (1, 1200), (2, 1200), (2, 1900)]


def test_a_complete_seed_is_skipped_and_a_missing_one_computed(tmp_path):
    first = run(tmp_path, *TABULAR)
    before = {f.name: f.stat().st_mtime_ns for f in first.directory.glob("seed_*")}
    made = [results(first, seed) for seed in (0, 1)]
    (first.directory / "seed_0001.json").write_text('{"status": "comp')  # cut off
    assert not is_complete(first.directory, 1)
    again = run(tmp_path, *TABULAR)
    after = {f.name: f.stat().st_mtime_ns for f in again.directory.glob("seed_*")}
    kept = {name for name in before if before[name] == after[name]}
    assert kept == {"seed_0000.csv", "seed_0000.json", "seed_0000.npz"}
    assert [results(again, seed) for seed in (0, 1)] == made


def test_a_folder_of_another_config_is_rejected_with_the_difference(tmp_path):
    run(tmp_path, *TABULAR, "tag=mine", "algorithm.episodes=5")
    with pytest.raises(BcrlError, match=r"algorithm\.episodes: there 5, here 6"):
        run(tmp_path, *TABULAR, "tag=mine", "algorithm.episodes=6")


@pytest.mark.parametrize("content", [b"\xff\xfe", b"a: 1", b"- x", b"a: ["])
def test_a_damaged_config_is_named(tmp_path, content):
    p = plan(*TABULAR, f"runs_dir={tmp_path}")
    p.directory.mkdir(parents=True)
    (p.directory / "config.yaml").write_bytes(content)
    with pytest.raises(BcrlError, match=r"(?s)config.yaml .*move it away"):
        runner.run(p)


def final_q(p, seed: int) -> np.ndarray:
    return np.load(p.directory / f"seed_{seed:04d}.npz")["q"]


def test_seeds_differ_in_data_and_in_trees(tmp_path):
    """Each alone suffices: first the data are shared, then there are no trees."""
    hill = ("env=car_on_hill", *FQI, "algorithm.dataset=shared")
    for p in (run(tmp_path, *hill), run(tmp_path, *TABULAR)):
        assert not np.array_equal(final_q(p, 0), final_q(p, 1))


def test_measuring_fqi_leaves_training_unchanged(tmp_path):
    """A learner without evaluation ends with the same Q, bit for bit."""
    measured = run(tmp_path, *MAZE)
    *_, last = learn(measured.stages, SeedBatch((0, 1), measured.target.states()))
    for seed in (0, 1):
        assert np.array_equal(last.probed_q[seed], final_q(measured, seed))


def test_evaluating_dqn_twice_as_often_leaves_training_unchanged(tmp_path):
    ends, found = [], []
    for every in (400, 200):
        often = f"algorithm.evaluate_every={every}"
        p = run(tmp_path / str(every), *LINEAR, "variant=SBC", often, "tag=x")
        *_, last = learn(p.stages, SeedBatch((0, 1), np.zeros((1, 4))))
        ends.append(last.result.residual.online.flat.numpy().copy())
        # The loss is a mean over another span.
        kept = [{k: v for k, v in r.items() if k != "loss"} for r in rows(p, 0)]
        found.append({row["step"]: row for row in kept if row["stage"] == 2})
    assert np.array_equal(*ends) and len(found[1]) > len(found[0])
    assert found[0] == {step: found[1][step] for step in found[0]}


@pytest.mark.slow
@pytest.mark.parametrize(
    "choice",
    [
        *("maze dqn plain", "maze dqn SBC", "maze dqn RPL", "car_on_hill dqn BC"),
        *("car_on_hill dqn PPR", "linear_system fqi BC", "linear_system fqi SBC"),
        *("maze fqi SC", "linear_system dqn B"),
    ],
)
def test_combinations_beyond_the_paper_run(tmp_path, choice):
    env, algorithm, variant = choice.split()
    small = ["scale.max_steps=60", "scale.max_episodes=3", "seeds.count=1"]
    if algorithm == "dqn":
        small += ["algorithm.random_steps=40", "algorithm.learning_starts=40"]
        small += ["algorithm.evaluation_episodes=2"]
    else:
        small += ["algorithm.regressor.trees=3"]
    named = (f"env={env}", f"algorithm={algorithm}", f"variant={variant}")
    p = run(tmp_path, *named, "scale=smoke", "progress=none", *small, "tag=x")
    assert is_complete(p.directory, 0)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_run_is_much_like_a_cpu_run(tmp_path):
    here = run(tmp_path / "cpu", *LINEAR, "variant=BC")
    there = run(tmp_path / "gpu", *LINEAR, "variant=BC", "device=cuda")
    assert rows(there, 0)[5]["q_mean"] == pytest.approx(rows(here, 0)[5]["q_mean"])


# --- failures ---


class Broken:
    """A regressor that rejects its work."""

    finite_only = False

    def fit(self, problems, keep, threads):
        raise ConfigError("key", 1, "must be 2")


def broken(folder: Path, workers: int):
    p = plan("env=maze", *FQI, f"runs_dir={folder}")
    learner = replace(p.stages[0].learner, regressor=Broken())
    stages = (replace(p.stages[0], learner=learner),)
    return replace(p, stages=stages, config=p.config | {"workers": workers})


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_failing_job_leaves_the_others_alone_and_is_reported(tmp_path, workers):
    bad = broken(tmp_path, workers)
    good = plan("env=maze", "variant=C", *FQI, f"runs_dir={tmp_path}")
    with pytest.raises(runner.SeedsFailed) as failed:
        runner.run(bad, good)
    text = str(failed.value)
    assert "2 seeds failed" in text
    assert "maze FQI, seeds 0–1: key=1: must be 2" in text
    assert f"  {bad.command}\n" in text + "\n" and good.command not in text
    assert pending(good) == []
    for seed in bad.seeds:
        assert about(bad, seed)["status"] == "failed: key=1: must be 2"
        assert not (bad.directory / f"seed_{seed:04d}.csv").exists()
    runner.run(plan(*bad.command.split()[1:]))  # failed seeds are tried again
    assert pending(bad) == []


def test_an_unforeseen_error_shows_where_it_came_from(tmp_path, capsys, monkeypatch):
    p = broken(tmp_path, 1)
    # A regressor fails one seed, not the job: its message has the line.
    monkeypatch.setattr(Broken, "fit", lambda *_: 1 / 0)
    with pytest.raises(runner.SeedsFailed, match=r"division by zero .*test_runs\.py:"):
        runner.run(p)
    assert "Traceback" not in capsys.readouterr().err
    monkeypatch.setattr(Learner, "_collect", lambda *_: 1 / 0)
    with pytest.raises(runner.SeedsFailed, match="ZeroDivisionError: division by zero"):
        runner.run(p)
    assert "Traceback" in capsys.readouterr().err


def test_a_diverging_seed_is_recorded_and_reported(tmp_path, capsys):
    choice = (*DQN, "variant=BC", "algorithm.learning_rate=1e30")
    p = plan(*choice, f"runs_dir={tmp_path}")
    with pytest.raises(
        runner.SeedsFailed, match="0–1: non-finite weights at step 2540"
    ):
        runner.run(p)
    assert about(p, 0)["status"] == "failed: non-finite weights at step 2540"
    assert math.isnan(rows(p, 0)[-1]["q_mean"])
    assert "seed 0 failed: non-finite weights" in capsys.readouterr().err
    assert pending(p) == [0, 1]


# --- the command ---


@pytest.mark.slow
def test_a_sweep_with_a_failing_job_exits_with_1_and_names_the_command(bcrl, tmp_path):
    sweep = (*DQN, "variant=BC", "seeds.count=1", "algorithm.learning_rate=1e-4,1e30")
    done = bcrl("-m", *(word for word in sweep if word != "tag=x"))
    assert done.returncode == 1, done.stderr
    assert "1 seed failed" in done.stderr and "Traceback" not in done.stderr
    command = done.stderr.split("to run just this again:\n  ")[1].splitlines()[0]
    assert "algorithm.learning_rate=1e+30" in command and "1e-4" not in command
    assert len(list(tmp_path.glob("runs/smoke/linear_system/*/seed_0000.csv"))) == 2
    again = bcrl(*shlex.split(command)[1:])
    assert again.returncode == 1 and "1 seed failed" in again.stderr


@pytest.mark.slow
def test_the_command_runs_a_sweep_with_a_line_per_task(bcrl, tmp_path):
    small = ("scale=smoke", "seeds.count=1", "algorithm/regressor=tabular", "tag=t")
    for first in (True, False):  # the second time all seeds are complete
        done = bcrl("-m", "env=maze", "curriculum=on,off", *small)
        assert done.returncode == 0, done.stderr
        assert ("C-FQI@t · T10 · iteration 20/20 · seed 0" in done.stderr) == first
        assert ("maze C-FQI@t: 1 of 1 seeds complete" in done.stderr) != first
    made = tmp_path.glob("runs/smoke/maze/*/seed_0000.json")
    commands = [json.loads(path.read_text())["command"] for path in made]
    assert (
        commands
        == [shlex.join(["bcrl", "-m", "env=maze", "curriculum=on,off", *small])] * 2
    )
