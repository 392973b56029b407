"""Episodes that runs record, and the GIFs that the report makes of them."""

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from bcrl.envs.car_on_hill import CarOnHill
from bcrl.envs.rendering import draw
from bcrl.report.animation import frames, typical_seed
from bcrl.report.load import load_runs
from bcrl.results.layout import seed_path
from bcrl.results.read import read_arrays
from tests.report.runs import report
from tests.results.made_up import made_up_plan, write_seeds
from tests.run.runs import FQI, run

CAR = CarOnHill(mass=1.2)
SECTION = {"name": "car_on_hill", "tasks": {"mass": [0.8, 1.2]}, "gamma": 0.95}
SECTION |= {"horizon": 100, "metrics": ["q_error", "return"]}


def episode(length: int = 6) -> dict[str, np.ndarray]:
    """What a run of the car records, driven to the right."""
    states, actions = [CAR.initial(np.empty(0))], np.ones(length, np.int64)
    for action in actions:
        states.append(CAR.step(states[-1], action)[0])
    return {"trajectory": np.stack(states), "trajectory_actions": actions}


def write_cars(runs_dir, name="BC-FQI", returns=(0.5,), arrays=None, section=SECTION):
    """Complete runs of the car; seed i ends with `returns[i]`."""
    seeds, config = range(len(returns)), {"env": section}
    made = made_up_plan(runs_dir, "car_on_hill", name, seeds, config=config)
    row = {"stage": 1, "task": 1, "iteration": 1, "q_error": 1.0}
    tables = [pd.DataFrame([row | {"return": value}]) for value in returns]
    write_seeds(made, tables.__getitem__, lambda seed: arrays or episode())


def gifs(runs_dir, *options: str) -> list[str]:
    """The variants that bcrl-report made GIFs of."""
    assert report(runs_dir, "--figures", "5", *options) == 0
    return [path.stem.split("_")[-2] for path in sorted(runs_dir.glob("figures/*.gif"))]


def recorded(runs_dir, *choice: str):
    """Run a plan; the plan, states and actions of each seed's episode."""
    p = run(runs_dir, *choice, *FQI)
    for seed in p.seeds:
        path = seed_path(p.directory, seed, "npz")
        yield p, *read_arrays(path, "trajectory", "trajectory_actions")


@pytest.mark.parametrize("env", ["maze", "car_on_hill"])
def test_a_recorded_episode_is_what_the_task_makes_of_its_actions(env, tmp_path):
    for p, states, actions in recorded(tmp_path, f"env={env}", "variant=C"):
        assert (states[0] == p.target.initial(np.empty(0))).all()
        after, _, absorbing = p.target.step(states[:-1], actions)
        np.testing.assert_allclose(after, states[1:], atol=1e-12)
        assert not absorbing[:-1].any()
        assert absorbing[-1] or len(actions) == p.target.horizon


@pytest.mark.slow
def test_dqn_records_a_greedy_episode_of_the_target(tmp_path):
    choice = ("env=linear_system", "algorithm=dqn", "variant=RPL")
    for p, states, actions in recorded(tmp_path, *choice):
        assert abs(states[0] - [-4, 0, 0, 0]).max() <= 0.4
        noise = np.full((len(actions), 8), 0.5)  # no push; a fresh start in the middle
        after, _, _ = p.target.step(states[:-1], actions, noise)
        kept = abs(after - [-4, 0, 0, 0]).max(-1) > 1e-9
        assert kept.any()
        np.testing.assert_allclose(after[kept], states[1:][kept], atol=1e-4)


def test_a_gif_shows_each_step_of_the_recorded_episode(tmp_path, capsys):
    write_cars(tmp_path)
    assert gifs(tmp_path, "--gif") == ["BC-FQI"]
    path = tmp_path / "figures" / "agent_car_on_hill_BC-FQI_smoke.gif"
    assert str(path) in capsys.readouterr().out
    states, actions = episode().values()
    with Image.open(path) as gif:
        assert gif.n_frames == len(states) and gif.info["loop"] == 0
        for t, action in enumerate([*actions, None]):
            gif.seek(t)
            assert gif.info["duration"] == (1500 if action is None else 100)
            caption = f"BC-FQI, seed 0, step {t}"
            expected = draw(CAR, states[: t + 1], action, caption).astype(int)
            shown = np.asarray(gif.convert("RGB"), int)
            assert abs(shown - expected).mean() < 1.0  # of 255: the palette's error


def test_which_variants_are_shown(tmp_path, capsys):
    names = ("BC-FQI", "C-FQI", "B-FQI@mine", "FQI@mine")
    for name, value in zip(names, (0.1, 0.3, 0.2, 0.4), strict=True):
        write_cars(tmp_path, name, (value,))
    for options, shown in (
        ([], []),
        (["--gif"], ["BC-FQI"]),
        (["--gif", "C-FQI", "BC-FQI"], ["BC-FQI", "C-FQI"]),
        (["--gif", "FQI@mine"], ["FQI@mine"]),
        (["--gif", "--tag", "mine"], ["FQI@mine"]),  # the better one
    ):
        assert gifs(tmp_path, *options) == shown
        for path in tmp_path.glob("figures/*.gif"):
            path.unlink()
    capsys.readouterr()
    assert report(tmp_path, "--gif", "B-FQI@mien") == 2
    err = capsys.readouterr().err
    assert "--gif B-FQI@mien" in err and "B-FQI@mine?" in err


def test_the_seed_shown_is_neither_the_best_nor_the_worst(tmp_path):
    write_cars(tmp_path, returns=(0.9, 0.1, 0.5, 0.7, 0.2))
    (variant,) = load_runs(tmp_path, "smoke").variants
    assert typical_seed(variant) == 2


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"arrays": {"trajectory": np.zeros((7, 2))}}, "trajectory_actions"),
        ({"arrays": episode() | {"trajectory": np.zeros((7, 1))}}, "Error: "),
        ({"section": SECTION | {"name": "my.car"}}, "a config alone can't name code"),
    ],
)
def test_a_run_that_cannot_be_shown_is_named(changed, message, tmp_path, capsys):
    write_cars(tmp_path, **changed)
    assert gifs(tmp_path, "--gif") == []
    err = capsys.readouterr().err
    assert "agent_car_on_hill_BC-FQI_smoke.gif: " in err and message in err


@pytest.mark.slow
def test_a_simulators_episode_is_played_once_more(tmp_path):
    pytest.importorskip("pygame")
    options = ("tag=x", "env.horizon=12", "env.starts=2", *FQI)
    made = run(tmp_path, "env=cart_pole", "variant=BC", *options)
    assert len(gifs(tmp_path, "--gif")) == 1
    (variant,) = load_runs(tmp_path, "smoke").variants
    shown, _ = frames(variant, 0)
    (actions,) = variant.arrays(0, "trajectory_actions")
    assert len(shown) == len(actions) + 1
    env = made.target.make("rgb_array")
    (start,) = variant.arrays(0, "trajectory_start")
    env.reset(seed=int(start[0] * 2**31))
    for action, picture in zip(actions, shown[1:], strict=True):
        env.step(action)
        np.testing.assert_array_equal(picture, env.render())
