"""The API for notebooks: processes, saved frames, rows as they come, figures."""

import importlib
import inspect
import re
import subprocess
import sys
import threading
from dataclasses import dataclass, field, replace

import gymnasium
import numpy as np
import pandas as pd
import pytest
from gymnasium.envs.classic_control import CartPoleEnv
from matplotlib.colors import to_hex
from pandas.testing import assert_frame_equal

from bcrl import api
from bcrl.api import (
    DQN,
    FQI,
    Boost,
    LinearSystem,
    Maze,
    PolicyReuse,
    ResidualPolicy,
    Shape,
    Sklearn,
    Tabular,
)
from bcrl.errors import BcrlError, ConfigError
from bcrl.report.figures import style
from bcrl.results.layout import DQN_METRICS
from bcrl.results.statistics import bootstrap_curves
from tests.run.runs import TABULAR, run

FAST = FQI(iterations=2, episodes=20, regressor=Tabular())
FEW = DQN(steps=60, random_steps=20, learning_starts=20, evaluate_every=40)
FEW = replace(FEW, evaluation_episodes=2, hidden=(8,))
TASKS = [Maze(height=height) for height in (0.5, 0.95)]
COURSE = api.stages(TASKS, FAST, Boost())


def trained(course=COURSE, seeds=(0, 1), **options) -> pd.DataFrame:
    return api.run(course, seeds, progress=False, **options)


def same(one: pd.DataFrame, other: pd.DataFrame) -> bool:
    """Whether two frames are equal to the last bit, column types included."""
    assert_frame_equal(one, other, check_exact=True)
    return True


def test_processes_change_nothing_and_take_what_a_notebook_defines():
    @dataclass(frozen=True)
    class Lower(Maze):
        """An environment that no module has."""

    course = api.stages(
        [Lower(height=0.4), Lower(height=0.5)],
        FAST,
        lambda start, previous: replace(start, base=previous.q),
    )
    seen: list[dict] = []
    alone = trained(course, (7, 0, 3))
    assert same(trained(course, (7, 0, 3), workers=2, on_row=seen.append), alone)
    # Each process reports its own rows in order.
    for seed in (7, 0, 3):
        rows = pd.DataFrame([row for row in seen if row["seed"] == seed])
        assert same(rows, alone[alone.seed == seed].reset_index(drop=True))


def test_other_processes_know_what_this_one_has_registered(tmp_path, monkeypatch):
    (tmp_path / "my_poles.py").write_text("import tests.toys")
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("my_poles")
    gymnasium.register("Mine-v0", entry_point=CartPoleEnv, max_episode_steps=20)
    try:
        for name in ("Mine-v0", "my_poles:Mine-v0"):
            tasks = [api.Gymnasium(name, kwargs={"sutton_barto_reward": True})]
            course = api.stages(tasks, replace(FAST, regressor=api.Forest(trees=2)))
            assert same(trained(course, workers=2), trained(course))
    finally:
        del gymnasium.registry["Mine-v0"], sys.modules["my_poles"]


@pytest.mark.slow
@pytest.mark.parametrize("course", [COURSE, api.stages([LinearSystem()], FEW)])
def test_any_number_of_processes_gives_the_same_bits(course):
    alone = trained(course, range(5))
    for workers in (2, 3, 9):
        assert same(trained(course, range(5), workers=workers, device="auto"), alone)


@dataclass(frozen=True)
class Locked(Maze):
    """An environment that can't leave its process."""

    lock: object = field(default_factory=threading.Lock, compare=False)


def test_what_cannot_be_sent_to_a_process_is_named():
    with pytest.raises(ConfigError, match=r"workers=2: .*lock"):
        trained(api.stages([Locked()], FAST), workers=2)
    assert len(trained(api.stages([Locked()], FAST))) == 2 * 2


@dataclass(frozen=True)
class Wrong(Tabular):
    """A regressor that fails."""

    def fit(self, *arguments):
        raise ZeroDivisionError("no")


@pytest.mark.slow
def test_a_failure_in_a_process_ends_the_call():
    course = api.stages([Maze()], replace(FAST, regressor=Wrong()))
    with pytest.raises(BcrlError, match=r"seed [01]: .*ZeroDivisionError: no"):
        trained(course, workers=2)

    def stop(row: dict) -> None:
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        trained(workers=2, on_row=stop)


def test_each_row_comes_at_once_and_is_the_frames():
    seen = []

    def note(row: dict) -> None:
        seen.append(dict(row))
        row.clear()  # is the function's own

    frame = trained(on_row=note)
    assert same(pd.DataFrame(seen), frame)
    assert len(frame) == 2 * 4 and list(frame.iteration[:3]) == [1, 1, 2]


def test_a_saved_frame_is_read_back_exactly(tmp_path):
    path = tmp_path / "frame.csv"
    path.write_text("old")
    frame = trained(save=path)
    assert same(api.read(path), frame) and same(api.read(str(path)), frame)
    assert [p.name for p in tmp_path.iterdir()] == ["frame.csv"]
    steps = trained(api.stages([LinearSystem()], FEW), save=str(path))
    assert same(api.read(path), steps) and steps.loss.isna().any()


def test_read_names_the_method_of_a_folder(tmp_path):
    made = run(tmp_path, *TABULAR, "algorithm.episodes=9", "tag=few")
    frame = api.read(made.directory)
    assert set(frame.method) == {"FQI@few"} and set(frame.seed) == {0, 1}
    with pytest.raises(BcrlError, match="seed_"):
        api.read(tmp_path)


BAD = {
    "workers": (0, -1, 2.0, True, "2", None),
    "threads": (0, 1.5),
    "device": ("gpu", "cuda:0"),
    "save": (".", "missing/a.csv", 3),
    "on_row": (3, "print"),
    "seeds": (3, (), (0, 0), (-1,)),
}


@pytest.mark.parametrize("key", BAD)
def test_a_bad_argument_is_named_before_any_work(key, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def never(row: dict) -> None:
        raise AssertionError("work began")

    for value in BAD[key]:
        with pytest.raises(ConfigError) as error:
            trained(**{"on_row": never} | {key: value})
        assert error.value.key == key and error.value.value == value


def test_methods_are_named_as_by_the_command():
    systems = [LinearSystem(drift=drift) for drift in (-0.2, -0.5)]
    named = {
        "FQI": api.stages([TASKS[1]] * 2, FAST),
        "C-FQI": api.stages(TASKS, FAST),
        "B-FQI": api.stages([TASKS[1]] * 2, FAST, Boost()),
        "BC-FQI": COURSE,
        "SBC-DQN": api.stages(systems, FEW, Boost(), Shape()),
        "RPL": api.stages(systems, FEW, ResidualPolicy()),
        "PPR-BC-DQN": api.stages(systems, FEW, PolicyReuse(), Boost()),
    }
    assert {name: api.about(course)[0] for name, course in named.items()} == {
        name: name for name in named
    }


def test_columns_name_the_settings_that_are_not_defaults():
    frame = trained(api.stages([Maze()], replace(FAST, epsilon=0.5)), [0])
    settings = frame.filter(like="learner.").iloc[0].to_dict()
    assert settings == {
        "learner.iterations": 2,
        "learner.episodes": 20,
        "learner.regressor": "tabular",
        "learner.epsilon": 0.5,
    }
    own = Sklearn("Ridge", {"alpha": 0.5})
    _, found = api.about(api.stages([Maze()], replace(FAST, regressor=own)))
    assert found["learner.regressor"] == "sklearn"
    assert found["learner.regressor.arguments"] == "{'alpha': 0.5}"


def curves(figure) -> dict[str, np.ndarray]:
    """The values of each curve by its name in the legend."""
    (legend,), (axes,) = figure.legends, figure.axes
    names = [text.get_text() for text in legend.get_texts()]
    return dict(zip(names, [line.get_ydata() for line in axes.lines], strict=True))


def test_a_figure_has_the_mean_and_the_reports_interval_and_colour():
    many = trained(seeds=range(6))
    figure = api.plot(many)
    values = many.pivot(index="iteration", columns="seed", values="return").to_numpy()
    (drawn,) = curves(figure).values()
    assert np.allclose(drawn, values.mean(axis=1))
    (axes,) = figure.axes
    assert to_hex(axes.lines[0].get_color()) == style.colour("BC-FQI").lower()
    (band,) = axes.collections
    low, high = bootstrap_curves(values.T)
    corners = band.get_paths()[0].vertices[:, 1]
    assert corners.min() == pytest.approx(low.min())
    assert corners.max() == pytest.approx(high.max())
    assert figure._repr_png_().startswith(b"\x89PNG")  # a notebook shows it


def test_frames_of_several_calls_are_drawn_together():
    other = trained(api.stages(TASKS, replace(FAST, episodes=30), Boost()))
    eager = trained(api.stages(TASKS, replace(FAST, epsilon=0.5), Boost()))
    both = pd.concat([trained(), other, eager, trained(api.stages(TASKS, FAST))])
    assert [*curves(api.plot(both, metric="solved"))] == [
        "BC-FQI episodes=20",
        "BC-FQI episodes=30",
        "BC-FQI episodes=20, epsilon=0.5",
        "C-FQI",
    ]
    warm = trained(api.stages([Maze()], replace(FAST, evaluate_every=2)))
    rare = pd.concat([trained(api.stages([Maze()], FAST)), warm])
    assert [*curves(api.plot(rare))] == ["FQI", "FQI evaluate_every=2"]
    mine = trained().assign(method="mine").drop(columns="learner.episodes")
    assert [*curves(api.plot(mine))] == ["mine"]


def test_what_cannot_be_drawn_is_explained():
    frame, steps = trained(), trained(api.stages([LinearSystem()], FEW))
    assert len(curves(api.plot(steps, "q_mean"))) == 1
    with pytest.raises(BcrlError, match=r"metric=retrun: .*return"):
        api.plot(frame, "retrun")
    with pytest.raises(BcrlError, match=r"iteration or step"):
        api.plot(pd.concat([frame, steps]))
    with pytest.raises(BcrlError, match="two rows"):
        api.plot(pd.concat([frame, frame]))
    with pytest.raises(BcrlError, match="no rows"):
        api.plot(frame[:0])
    with pytest.raises(BcrlError, match="seed"):
        api.plot(frame.drop(columns="seed"))
    with pytest.raises(BcrlError, match="metric=note"):
        api.plot(frame.assign(note="a"), "note")
    lists = frame.assign(**{"learner.layers": [[8, 8]] * len(frame)})
    with pytest.raises(BcrlError, match=r"learner\.layers"):
        api.plot(lists)
    assert set(DQN_METRICS) <= set(steps)


@pytest.mark.parametrize("function", [api.run, api.plot, api.stages])
def test_help_explains_every_parameter(function):
    text = inspect.getdoc(function)
    for name in inspect.signature(function).parameters:
        assert re.search(rf"\b{name}\b", text), name
    if function is api.run:
        listed = re.findall(r"^    (\w+): ", text, re.M)
        assert listed[: len(inspect.signature(api.run).parameters)] == [
            *inspect.signature(api.run).parameters
        ]


@pytest.mark.slow
def test_a_script_with_processes_needs_no_guard(tmp_path):
    program = """if True:
        from bcrl.api import *
        print("begun")
        class Mine(Maze):
            pass
        course = stages([Mine()], FQI(2, 20, Tabular()))
        print(len(run(course, [0, 1], progress=False, workers=2)))
    """
    (tmp_path / "script.py").write_text(program)
    for words, given in ((["script.py"], ""), (["-"], program)):
        command = [sys.executable, *words]
        options = {"input": given, "capture_output": True, "text": True}
        done = subprocess.run(command, cwd=tmp_path, **options)
        assert done.stdout == "begun\n4\n", done.stderr
