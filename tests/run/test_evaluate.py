"""`bcrl-eval`: the task it plays, the intervals it prints, the transitions it logs."""

import numpy as np
import pandas as pd
import pytest

import bcrl
from bcrl.envs.gymnasium import Gymnasium
from bcrl.errors import BcrlError
from bcrl.learning.transitions import read_transitions
from bcrl.run import evaluate
from tests.run.runs import HILL, KINDS, rows, run


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return run(tmp_path_factory.mktemp("runs"), *KINDS["car_on_hill BC"])


def test_episodes_are_evaluated_in_a_task_of_choice(made, tmp_path):
    words = [str(made.directory), "--episodes", "7"]
    assert evaluate.main(words) == 0
    path = made.directory / "evaluation.csv"
    first = path.read_text()
    lines = first.splitlines()
    assert len(lines) == 1 + 2 * 7 and lines[0].startswith("seed,episode,return")
    out = ["--out", str(tmp_path / "other.csv")]
    assert evaluate.main([*words, "--task", "3", *out]) == 0
    assert (tmp_path / "other.csv").read_text() == first  # the target
    assert evaluate.main([*words, "env.mass=0.8", *out]) == 0
    assert evaluate.main([*words, "--task", "1", "--out", str(path)]) == 0
    assert (tmp_path / "other.csv").read_text() == path.read_text() != first
    assert (pd.read_csv(path)["task"] == "mass=0.8").all()
    assert evaluate.main([*words, "env.horizon=50", "--task", "1"]) == 0
    assert (pd.read_csv(path)["task"] == "mass=0.8, horizon=50").all()
    wrongs = ["env.mas=1"], ["mass=1"], ["--task", "4"], ["--episodes", "0"]
    for wrong in (*wrongs, ["env.mass=[1"], ["env.mass='1"], ["env.mass.x=1"]):
        assert evaluate.main([str(made.directory), *wrong]) == 2
    assert evaluate.main([str(tmp_path)]) == 2


def test_arguments_of_a_gymnasium_environment_are_changed():
    task = Gymnasium(id="CartPole-v1", horizon=5)
    config = {"env": {"tasks": {"kwargs": None}}}
    assert evaluate.task_text(config, task, []) == "target"
    word = "env.kwargs.sutton_barto_reward=true"
    other = evaluate.changed(task, [word])
    assert other.kwargs == {"sutton_barto_reward": True}
    said = evaluate.task_text(config, other, [word])
    assert said == "kwargs={'sutton_barto_reward': True}"
    for wrong in ("env.sutton_barto_reward=true", "env.tasks.kwargs=[{}]"):
        with pytest.raises(BcrlError, match=r"env\.kwargs\.NAME"):
            evaluate.changed(task, [wrong])


def test_intervals_are_over_seeds_or_over_the_episodes_of_one():
    # Of two seeds, a resampled mean is 1, 2 or 3, each more often than in 2.5 %.
    two = pd.DataFrame({"seed": [4, 4, 7, 7], "return": [0.0, 2.0, 2.0, 4.0]})
    two["discounted_return"] = two["return"] / 4
    found = evaluate.means(two)
    assert "2 seeds" in found
    assert found.endswith(
        "return 2.000 [1.000, 3.000], discounted_return 0.5000 [0.2500, 0.7500]"
    )
    # Of three episodes, the resampled mean is the least one in 1/27 of all draws.
    one = pd.DataFrame({"seed": 4, "return": [0.0, 3.0, 6.0], "discounted_return": 1.0})
    found = evaluate.means(one)
    assert "3 episodes of seed 4" in found and "return 3.000 [0.000, 6.000]" in found


def test_recorded_transitions_are_what_was_played_and_are_learned_from(made, tmp_path):
    file, csv = tmp_path / "log.npz", tmp_path / "rows.csv"
    words = [str(made.directory), "--task", "1", "--episodes", "3", "--out", str(csv)]
    for wrong in ("log.csv", "nowhere/log.npz"):
        assert evaluate.main([*words, "--record", str(tmp_path / wrong)]) == 2
        assert not csv.exists()
    assert evaluate.main([*words, "--record", str(file)]) == 0
    data, listed = read_transitions(file), pd.read_csv(csv)
    assert listed["seed"].tolist() == [0, 0, 0, 1, 1, 1]
    assert np.bincount(data.episode).tolist() == listed["steps"].tolist()
    assert np.bincount(data.episode, data.reward).tolist() == listed["return"].tolist()
    after, reward, absorbing = made.tasks[0].step(data.observation, data.action)
    assert (data.next_observation == after).all()
    assert (data.reward == reward).all() and (data.absorbing == absorbing).all()
    goes_on = np.diff(data.episode) == 0
    assert (data.observation[1:] == after[:-1])[goes_on].all()
    for seed in (0, 1):
        own = data.episode // 3 == seed
        values = bcrl.load(made.directory, seed).q(data.observation[own])
        chosen = np.take_along_axis(values, data.action[own, None], axis=1)[:, 0]
        assert (chosen == values.max(1)).all()
    words = (*HILL, "env.tasks.mass=[0.8]", "algorithm.iterations=2")
    learned = run(tmp_path, *words, f"algorithm.dataset={file}")
    assert np.isfinite([row["return"] for row in rows(learned, 1)]).all()
    assert bcrl.load(learned.directory, 1).q(data.observation).any()
