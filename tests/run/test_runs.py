"""Whole runs at smoke scale: records, identical bytes, resume, conflicts."""

import csv
import hashlib
import itertools
import json
import math
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bcrl.errors import BcrlError, ConfigError
from bcrl.learning.fqi import FQI
from bcrl.learning.stage import SeedBatch, learn
from bcrl.run import runner
from bcrl.run.records import is_complete
from tests.conftest import plan

COLUMNS = {
    "car_on_hill": "stage,task,iteration,q_error,return",
    "maze": "stage,task,iteration,return,q_error_start,q_error,residual_start,solved",
}
VARIANTS = list(itertools.product(COLUMNS, ("on", "off"), ("on", "off")))


def run(folder: Path, env: str, curriculum: str, boosting: str, *more: str):
    p = plan(
        f"env={env}",
        f"curriculum={curriculum}",
        f"boosting={boosting}",
        "scale=smoke",
        "progress=none",
        f"runs_dir={folder}",
        *more,
    )
    runner.run(p)
    return p


def digest(p, seed: int, suffix: str = "csv") -> str:
    data = (p.directory / f"seed_{seed:04d}.{suffix}").read_bytes()
    return hashlib.sha256(data).hexdigest()


@pytest.mark.parametrize(("env", "curriculum", "boosting"), VARIANTS)
def test_a_seed_is_the_same_alone_among_others_and_with_two_workers(
    tmp_path, env, curriculum, boosting
):
    choice = (env, curriculum, boosting)
    alone = run(tmp_path / "a", *choice, "seeds.first=3", "seeds.count=1", "threads=1")
    among = run(
        tmp_path / "b", *choice, "seeds.count=5", "seeds.lockstep=5", "threads=2"
    )
    two = run(
        tmp_path / "c",
        *choice,
        "seeds.first=2",
        "seeds.count=2",
        "workers=2",
        "threads=1",
    )
    for suffix in ("csv", "npz"):
        ways = {digest(p, 3, suffix) for p in (alone, among, two)}
        assert len(ways) == 1, suffix
    assert len({digest(among, s) for s in range(5)}) == 5  # seeds differ


@pytest.mark.parametrize("env", COLUMNS)
def test_what_a_run_leaves(tmp_path, env):
    p = run(tmp_path, env, "on", "on")
    assert p.directory == tmp_path / "smoke" / env / "BC-FQI"
    names = {f"seed_000{s}.{x}" for s in (0, 1) for x in ("csv", "json", "npz")}
    assert {f.name for f in p.directory.iterdir()} == names | {"config.yaml"}
    lines = (p.directory / "seed_0000.csv").read_text().splitlines()
    assert lines[0] == COLUMNS[env]
    rows = list(csv.DictReader(lines))
    assert [int(r["iteration"]) for r in rows] == list(range(1, 2 * len(p.tasks) + 1))
    assert [int(r["task"]) for r in rows] == [i // 2 + 1 for i in range(len(rows))]
    assert all(math.isfinite(float(v)) for r in rows for v in r.values())
    about = json.loads((p.directory / "seed_0000.json").read_text())
    assert about["status"] == "complete" and about["variant"] == "BC-FQI"
    assert about["config"]["env"]["name"] == env
    for key in ("versions", "git", "machine", "cpu_seconds", "wall_seconds"):
        assert about[key]
    arrays = np.load(p.directory / "seed_0000.npz", allow_pickle=False)
    n, a = len(arrays["states"]), p.target.n_actions
    assert arrays["q"].shape == (n, a)
    assert arrays["residuals"].shape == (len(p.stages), n, a)
    # Q is the sum of the residuals: boosting's definition.
    assert np.allclose(arrays["residuals"].sum(0), arrays["q"], atol=1e-12)
    if env == "maze":
        assert about["optimum"] == pytest.approx(-47.557563488, abs=1e-8)
        assert arrays["trajectory"][0].tolist() == [0.0, 0.0]
        assert arrays["walls"].shape == (10, 2, 4)


def test_a_complete_seed_is_skipped_and_a_missing_one_computed(tmp_path):
    first = run(tmp_path, "maze", "off", "off", "seeds.count=2")
    before = {f.name: f.stat().st_mtime_ns for f in first.directory.glob("seed_*")}
    digests = [digest(first, s) for s in (0, 1)]
    (first.directory / "seed_0001.json").write_text('{"status": "comp')  # cut off
    assert not is_complete(first.directory, 1)
    again = run(tmp_path, "maze", "off", "off", "seeds.count=2")
    after = {f.name: f.stat().st_mtime_ns for f in again.directory.glob("seed_*")}
    kept = {name for name in before if before[name] == after[name]}
    assert kept == {"seed_0000.csv", "seed_0000.json", "seed_0000.npz"}
    assert [digest(again, s) for s in (0, 1)] == digests


def test_a_directory_of_another_config_is_refused_with_the_difference(tmp_path):
    run(tmp_path, "maze", "off", "off", "tag=mine", "algorithm.episodes=5")
    with pytest.raises(BcrlError, match=r"algorithm.episodes: there 5, here 6"):
        run(tmp_path, "maze", "off", "off", "tag=mine", "algorithm.episodes=6")


def final_q(p, seed: int) -> np.ndarray:
    return np.load(p.directory / f"seed_{seed:04d}.npz")["q"]


def test_seeds_differ_in_data_and_in_trees(tmp_path):
    """Each alone suffices: first the data are shared, then there are no trees."""
    hill = ("car_on_hill", "off", "off")
    trees_differ = run(tmp_path, *hill, "algorithm.dataset=shared")
    assert not np.array_equal(final_q(trees_differ, 0), final_q(trees_differ, 1))
    data_differ = run(tmp_path, "maze", "off", "off", "algorithm/regressor=tabular")
    assert not np.array_equal(final_q(data_differ, 0), final_q(data_differ, 1))


def test_measuring_leaves_training_unchanged(tmp_path):
    """A learner that nobody evaluates ends with the same Q, to the bit."""
    measured = run(tmp_path, "maze", "on", "on")
    *_, last = learn(measured.stages, SeedBatch((0, 1), measured.target.states()))
    for seed in (0, 1):
        assert np.array_equal(last.probed_q[seed], final_q(measured, seed))


class Broken:
    """A regressor that refuses its work, as a full disk might."""

    finite_only = False

    def fit(self, problems, keep, threads):
        raise ConfigError("key", 1, "must be 2")


def broken(folder: Path, workers: int, *more: str):
    p = plan("env=maze", "scale=smoke", "progress=none", f"runs_dir={folder}", *more)
    learner = replace(p.stages[0].learner, regressor=Broken())
    stages = (replace(p.stages[0], learner=learner),)
    return replace(p, stages=stages, config=p.config | {"workers": workers})


@pytest.mark.parametrize("workers", [1, 2])
def test_a_failing_job_leaves_the_others_alone_and_is_told_at_the_end(
    tmp_path, workers
):
    bad = broken(tmp_path, workers)
    good = plan(
        "env=maze", "variant=C", "scale=smoke", "progress=none", f"runs_dir={tmp_path}"
    )
    with pytest.raises(runner.SeedsFailed) as failed:
        runner.run(bad, good)
    said = str(failed.value)
    assert "2 seeds failed" in said
    assert "maze FQI, seeds 0–1: key=1: must be 2" in said
    assert f"  {bad.command}\n" in said + "\n" and good.command not in said
    assert all(is_complete(good.directory, seed) for seed in good.seeds)
    for seed in bad.seeds:
        about = json.loads((bad.directory / f"seed_{seed:04d}.json").read_text())
        assert about["status"] == "failed: key=1: must be 2"
        assert not (bad.directory / f"seed_{seed:04d}.csv").exists()
    mended = plan(*bad.command.split()[1:])
    runner.run(mended)  # failed seeds are tried again
    assert all(is_complete(bad.directory, seed) for seed in bad.seeds)


def test_seeds_asked_for_in_parts_are_all_known(tmp_path):
    parts = [
        plan(
            "env=maze",
            "scale=smoke",
            "progress=none",
            f"seeds.first={first}",
            "seeds.count=1",
            f"runs_dir={tmp_path}",
        )
        for first in (0, 2)
    ]
    runner.run(*parts)
    about = json.loads((parts[0].directory / "seed_0002.json").read_text())
    assert about["asked"] == [[0, 0], [2, 2]]
    (merged,) = runner.merged(parts)
    assert merged.command.splitlines() == [part.command for part in parts]


def test_a_failing_job_leaves_the_others_alone(bcrl, tmp_path):
    sweep = ("env=linear_system", "algorithm=dqn", "variant=BC", "scale=smoke")
    sweep += ("algorithm.learning_rate=1e30,1e-4", "seeds.count=1")
    small = ("scale.max_steps=540", "algorithm.evaluation_episodes=3")
    done = bcrl("-m", *sweep, *small, "workers=2")
    assert done.returncode == 1, done.stderr
    assert "  bcrl env=linear_system" in done.stderr
    assert len(list(tmp_path.glob("runs/smoke/linear_system/*/seed_0000.csv"))) == 2


@pytest.mark.parametrize("content", [b"\xff\xfe", b"a: 1", b"- x", b"a: ["])
def test_a_damaged_config_is_named(tmp_path, content):
    p = plan("env=maze", "scale=smoke", "progress=none", f"runs_dir={tmp_path}")
    p.directory.mkdir(parents=True)
    (p.directory / "config.yaml").write_bytes(content)
    with pytest.raises(
        BcrlError, match=r"(?s)config.yaml can't be read .* move it away"
    ):
        runner.run(p)


def test_an_unforeseen_error_shows_where_it_came_from(tmp_path, capsys, monkeypatch):
    p = broken(tmp_path, 1)
    # A regressor's names its line, for it fails one seed and no job.
    monkeypatch.setattr(Broken, "fit", lambda *_: 1 / 0)
    with pytest.raises(runner.SeedsFailed, match=r"division by zero .*test_runs\.py:"):
        runner.run(p)
    assert "Traceback" not in capsys.readouterr().err
    monkeypatch.setattr(FQI, "_data", lambda *_: 1 / 0)
    with pytest.raises(runner.SeedsFailed, match="ZeroDivisionError: division by zero"):
        runner.run(p)
    assert "Traceback" in capsys.readouterr().err


def test_a_sweep_with_a_failing_job_exits_with_1_and_names_the_command(bcrl, tmp_path):
    sweep = ("env=linear_system", "algorithm=dqn", "variant=BC", "scale=smoke")
    sweep += ("algorithm.learning_rate=1e-4,1e30", "seeds.count=1")
    small = ("scale.max_steps=540", "algorithm.evaluation_episodes=3")
    done = bcrl("-m", *sweep, *small)
    assert done.returncode == 1, done.stderr
    assert "1 seed failed" in done.stderr and "Traceback" not in done.stderr
    command = done.stderr.split("to run just this again:\n  ")[1].splitlines()[0]
    assert "algorithm.learning_rate=1e+30" in command and "1e-4" not in command
    assert len(list(tmp_path.glob("runs/smoke/linear_system/*/seed_0000.csv"))) == 2
    again = bcrl(*shlex.split(command)[1:])
    assert again.returncode == 1 and "1 seed failed" in again.stderr


def test_the_released_maze_and_scikit_learns_forest_run(tmp_path):
    small = ("algorithm.regressor.trees=3", "seeds.count=1")
    released = run(tmp_path, "maze", "on", "on", "env.preset=released", *small)
    judge = run(
        tmp_path, "maze", "on", "on", "algorithm/regressor=sklearn_forest", *small
    )
    for p in (released, judge):
        assert is_complete(p.directory, 0)
        assert p.name.startswith("BC-FQI@")


def test_the_command_runs_a_sweep_and_prints_a_line_a_task(bcrl, tmp_path):
    sweep = ("env=maze", "curriculum=on,off", "scale=smoke", "seeds.count=1")
    done = bcrl("-m", *sweep, "algorithm/regressor=tabular", "tag=t")
    assert done.returncode == 0, done.stderr
    assert "C-FQI@t · T10 · iteration 20/20 · seed 0" in done.stderr
    made = sorted(
        p.parent.name for p in tmp_path.glob("runs/smoke/maze/*/seed_0000.csv")
    )
    assert made == ["C-FQI@t", "FQI@t"]


def test_cfg_shows_a_composition_and_help_needs_none(bcrl, tmp_path):
    shown = bcrl("--help")
    assert shown.returncode == 0 and "bcrl GROUP=OPTION" in shown.stdout
    composed = bcrl("env=maze", "--cfg", "job")
    assert composed.returncode == 0 and "height" in composed.stdout
    assert not list(tmp_path.iterdir())
