"""Metrics, recomputed by hand and from what a run leaves."""

import csv

import numpy as np
import pytest

from bcrl.envs.car_on_hill import CarOnHill
from bcrl.envs.maze import Maze
from bcrl.errors import ConfigError
from bcrl.evaluation import oracle
from bcrl.evaluation.metrics import check_metrics
from bcrl.run import runner
from tests.conftest import plan


def test_a_maze_run_recomputed_from_its_arrays(tmp_path):
    small = ("scale=smoke", "seeds.count=1", "progress=none", f"runs_dir={tmp_path}")
    p = plan("env=maze", "curriculum=on", "boosting=on", *small)
    runner.run(p)
    rows = list(csv.DictReader((p.directory / "seed_0000.csv").open()))
    with np.load(p.directory / "seed_0000.npz") as stored:
        residuals, path = stored["residuals"], stored["trajectory"]
    target_start = oracle.reference(Maze(0.95)).q[0].max()  # in every stage
    for stage, env in enumerate(p.tasks):
        row = {k: float(v) for k, v in rows[2 * stage + 1].items()}
        q = residuals[: stage + 1].sum(0)
        assert row["q_error_start"] == pytest.approx(abs(q[0] - target_start).mean())
        assert row["residual_start"] == pytest.approx(residuals[stage][0].mean())
        known = oracle.reference(env)  # the current task's
        error = abs(q[env.index(known.states)] - known.q).mean()
        assert row["q_error"] == pytest.approx(error)
    distance = abs(path[1:] - 0.95).sum(1)
    reward = np.where(distance < 0.1 + 1e-9, 5.0, -distance)
    discount = 0.99 ** np.arange(len(reward))
    assert row["return"] == pytest.approx((discount * reward).sum())
    assert row["solved"] == float(reward[-1] == 5.0)


@pytest.mark.parametrize("metrics", [["retrun"], [["return"]], ["q_error_start"]])
def test_impossible_metrics_are_rejected(metrics):
    with pytest.raises(ConfigError, match=r"env.metrics"):
        check_metrics(metrics, CarOnHill())
