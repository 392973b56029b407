"""Whole runs at smoke scale: their files, equal results in any grouping, failures."""

import json
import math
import shlex
from dataclasses import replace

import numpy as np
import pytest
import torch

from bcrl import api
from bcrl.errors import BcrlError, ConfigError
from bcrl.learning.stage import SeedBatch, learn
from bcrl.results.integrity import check_tree
from bcrl.run import job, runner
from bcrl.run.records import pending
from tests.conftest import plan
from tests.run.runs import KINDS, LINEAR, MAZE, TABULAR, about, results, rows, run

FAST = ("maze BC", "car_on_hill C", "dqn SBC")


@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=[pytest.mark.slow] * (k not in FAST)) for k in KINDS]
)
def test_a_seed_is_the_same_alone_and_among_others(tmp_path, kind):
    alone = run(tmp_path / "a", *KINDS[kind], "seeds=[3]", "threads=1")
    among = run(tmp_path / "b", *KINDS[kind], "seeds=4", "threads=2")
    assert results(alone, 3) == results(among, 3)
    assert len({results(among, seed)[1] for seed in range(4)}) == 4  # seeds differ


@pytest.mark.slow
def test_a_seed_is_the_same_alone_and_in_a_pool_with_other_plans(tmp_path):
    kinds, pool = ("maze C", "car_on_hill BC", "dqn BC"), (f"runs_dir={tmp_path}/pool",)
    pool = [plan(*KINDS[k], "workers=2", "threads=1", *pool) for k in kinds]
    runner.run(*pool)
    for kind, p in zip(kinds, pool, strict=True):
        alone = run(tmp_path / "alone", *KINDS[kind], "threads=1")
        assert [results(p, s) for s in (0, 1)] == [results(alone, s) for s in (0, 1)]


@pytest.mark.parametrize("env", ["car_on_hill", "maze"])
def test_the_files_of_an_fqi_run(tmp_path, env):
    p = run(tmp_path, *KINDS[f"{env} BC"])
    assert p.directory == tmp_path / "smoke" / env / "BC-FQI"
    names = {
        f"seed_000{s}.{x}" for s in (0, 1) for x in ("csv", "json", "npz", "agent")
    }
    assert {f.name for f in p.directory.iterdir()} == names | {"config.yaml"}
    assert check_tree(tmp_path)[1] == []  # headers, order of rows, finite values
    tasks = [row["task"] for row in rows(p, 0)]
    assert tasks == [1 + i // 2 for i in range(2 * len(p.tasks))]
    facts = about(p, 0)
    assert facts["status"] == "complete" and facts["variant"] == "BC-FQI"
    assert facts["config"]["env"]["name"] == env
    assert all(facts[k] for k in ("versions", "git", "machine", "cpu_seconds"))
    arrays = np.load(p.directory / "seed_0000.npz", allow_pickle=False)
    n, a = len(arrays["states"]), p.target.n_actions
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
    assert check_tree(tmp_path)[1] == []
    found = rows(p, 0)
    assert (
        [r["stage"] for r in found] == [r["task"] for r in found] == [1] * 5 + [2] * 2
    )
    assert [r["step"] for r in found] == [0, 500, 1000, 1500, 2000, 2000, 2700]
    assert [math.isnan(r["loss"]) for r in found] == [True] * 6 + [False]
    assert api.read(p.directory)["loss"].dtype == float  # though cells are empty
    assert b"nan" not in results(p, 0)[0]
    assert about(p, 0)["learners"] == ["lspi", "dqn"]
    arrays = np.load(p.directory / "seed_0000.npz", allow_pickle=False)
    assert arrays["q_stages"].shape == (2, 41 * 41, 8)
    assert np.array_equal(arrays["q"], arrays["q_stages"][-1])
    assert {"states", "actions", "pathway", "goal", "start", "drift"} <= set(arrays)


def test_a_complete_seed_is_skipped_and_a_changed_one_computed_again(tmp_path, capsys):
    p = run(tmp_path, *TABULAR)
    first, second = (p.directory / f"seed_000{seed}.csv" for seed in (0, 1))
    before, when = second.read_bytes(), first.stat().st_mtime_ns
    second.write_bytes(before.replace(b"1", b"2", 1))
    runner.run(p)
    assert second.read_bytes() == before and first.stat().st_mtime_ns == when
    assert "the CSV is not" in capsys.readouterr().err
    assert pending(p) == []


def test_a_folder_of_another_config_or_a_damaged_one_is_rejected(tmp_path):
    p = run(tmp_path, *TABULAR, "tag=mine", "algorithm.episodes=5")
    with pytest.raises(BcrlError, match=r"algorithm\.episodes: there 5, here 6"):
        run(tmp_path, *TABULAR, "tag=mine", "algorithm.episodes=6")
    for content in (b"\xff\xfe", b"a: 1", b"- x", b"a: ["):
        (p.directory / "config.yaml").write_bytes(content)
        with pytest.raises(BcrlError, match=r"(?s)config.yaml .*move it away"):
            runner.run(p)


def test_measuring_fqi_leaves_training_unchanged(tmp_path):
    measured = run(tmp_path, *MAZE)
    *_, last = learn(measured.stages, SeedBatch((0, 1), measured.target.states()))
    for seed in (0, 1):
        stored = np.load(measured.directory / f"seed_000{seed}.npz")
        assert np.array_equal(last.probed_q[seed], stored["q"])


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


def test_fqi_is_evaluated_seldom_outside_of_the_paper_and_its_results_are_sound(
    tmp_path,
):
    for words in (["env=maze"], ["env=car_on_hill"]):
        learners = [stage.learner for stage in plan(*words, "scale=paper").stages]
        assert {learner.evaluate_every for learner in learners} == {1}
    # An evaluation of 20 starts may cost 4 · (150 + 2 · 20) = 760 of the fitted rows.
    for iterations, episodes, every in ((20, 100, 10), (25, 100, 9), (50, 300, 3)):
        sizes = f"algorithm.iterations={iterations}", f"algorithm.episodes={episodes}"
        stages = plan("env=mountain_car", *sizes).stages
        assert {stage.learner.evaluate_every for stage in stages} == {every}
    words = (*TABULAR, "curriculum=off", "algorithm.iterations=5", "scale=quick")
    p = run(tmp_path, *words, "algorithm.evaluate_every=3", "seeds=1")
    assert [row["iteration"] for row in rows(p, 0)][:4] == [3, 5, 8, 10]
    assert check_tree(tmp_path)[1] == []


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_run_is_much_like_a_cpu_run(tmp_path):
    here = run(tmp_path / "cpu", *LINEAR, "variant=BC")
    there = run(tmp_path / "gpu", *LINEAR, "variant=BC", "device=cuda")
    assert rows(there, 0)[5]["q_mean"] == pytest.approx(rows(here, 0)[5]["q_mean"])


class Broken:
    """A regressor that rejects its work."""

    finite_only = False

    def fit(self, problems, keep, threads):
        raise ConfigError("key", 1, "must be 2")


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_failing_job_leaves_the_others_alone_and_is_reported(tmp_path, workers):
    bad = plan(*KINDS["maze plain"], f"runs_dir={tmp_path}", f"workers={workers}")
    learner = replace(bad.stages[0].learner, regressor=Broken())
    bad = replace(bad, stages=(replace(bad.stages[0], learner=learner),))
    good = plan(*KINDS["maze C"], f"runs_dir={tmp_path}")
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
    monkeypatch.setattr(job.Probe, "measure", lambda *_: 1 / 0)
    with pytest.raises(runner.SeedsFailed, match="ZeroDivisionError: division by zero"):
        run(tmp_path, *TABULAR)
    assert "Traceback" in capsys.readouterr().err


def test_a_diverging_seed_is_recorded_and_reported(tmp_path, capsys):
    p = plan(*KINDS["dqn BC"], "algorithm.learning_rate=1e30", f"runs_dir={tmp_path}")
    why = "non-finite weights at step 2540"
    with pytest.raises(runner.SeedsFailed, match=f"0–1: {why}"):
        runner.run(p)
    assert about(p, 0)["status"] == f"failed: {why}"
    assert math.isnan(rows(p, 0)[-1]["q_mean"])
    assert "seed 0 failed: non-finite weights" in capsys.readouterr().err
    assert pending(p) == [0, 1]


@pytest.mark.slow
def test_a_sweep_shows_progress_and_the_command_of_what_failed(bcrl, tmp_path):
    rates = ("algorithm.learning_rate=1e-4,1e30", "seeds.count=1", "progress=lines")
    words = ("-m", *KINDS["dqn BC"], *rates, "tag=null")
    done = bcrl(*words)
    assert done.returncode == 1, done.stderr
    assert "1 seed failed" in done.stderr and "Traceback" not in done.stderr
    assert "· step 2540/2540 · seed 0" in done.stderr
    made = list(tmp_path.glob("runs/smoke/linear_system/*/seed_0000.json"))
    commands = [json.loads(path.read_text())["command"] for path in made]
    assert commands == [shlex.join(["bcrl", *words])] * 2  # can be pasted
    command = done.stderr.split("to run just this again:\n  ")[1].splitlines()[0]
    assert "algorithm.learning_rate=1e+30" in command and "1e-4" not in command
    again = bcrl(*shlex.split(command)[1:])
    assert again.returncode == 1 and "1 seed failed" in again.stderr
