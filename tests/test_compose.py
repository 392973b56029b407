"""Composition: names, tags, directories, budgets, and every combination of groups."""

import itertools
from pathlib import Path

import pytest

from bcrl import vetting
from bcrl.curriculum import CURRICULA
from bcrl.errors import BcrlError
from bcrl.transfer import boost, warm_start
from tests.conftest import plan, plans

GROUPS = {
    group: sorted(p.stem for p in (vetting.CONF / group).glob("*.yaml"))
    for group in (
        *vetting.VARIANT_GROUPS,
        "algorithm/regressor",
        "budget",
        "experiment",
    )
}


@pytest.mark.parametrize(
    ("curriculum", "boosting", "name", "transfer"),
    [
        ("off", "off", "FQI", warm_start),
        ("on", "off", "C-FQI", warm_start),
        ("off", "on", "B-FQI", boost),
        ("on", "on", "BC-FQI", boost),
    ],
)
@pytest.mark.parametrize("env", GROUPS["env"])
def test_variants_are_named_by_what_they_are(env, curriculum, boosting, name, transfer):
    p = plan(f"env={env}", f"curriculum={curriculum}", f"boosting={boosting}")
    assert (p.name, p.transfer) == (name, transfer)
    assert p.directory == Path("runs/quick") / env / name
    tasks = [stage.task for stage in p.stages]
    n = len(p.tasks)
    assert tasks == (list(range(1, n + 1)) if curriculum == "on" else [n] * n)


def test_the_papers_budgets():
    maze = plan("env=maze", "curriculum=on")
    assert [s.iterations for s in maze.stages] == [10] * 4 + [20] * 2 + [50] * 4
    assert [s.epsilon for s in maze.stages] == [1] * 4 + [0.75] * 2 + [0.5] * 2 + [
        0.25
    ] * 2
    assert {s.episodes for s in maze.stages} == {500}
    assert all(s.new_data for s in maze.stages)
    assert [s.env.height for s in maze.stages][::9] == [0.05, 0.95]
    hill = plan("env=car_on_hill")
    assert [s.iterations for s in hill.stages] == [20] * 3
    assert [s.new_data for s in hill.stages] == [True, False, False]
    assert [s.env.mass for s in hill.stages] == [1.2] * 3
    assert all(
        s.new_data
        for s in plan("env=car_on_hill", "curriculum=on", "boosting=on").stages
    )


def test_scales_choose_seeds_and_cap_budgets():
    assert plan("env=maze").seeds == (0, 1, 2)
    assert len(plan("env=maze", "scale=paper").seeds) == 40
    assert len(plan("env=car_on_hill", "scale=paper").seeds) == 20
    assert plan("env=maze", "seeds.first=5", "seeds.count=2").seeds == (5, 6)
    smoke = plan("env=maze", "scale=smoke")
    assert {(s.iterations, s.episodes) for s in smoke.stages} == {(2, 20)}


def test_outputs_seeds_and_workers_do_not_count_towards_the_identity():
    same = plan("env=maze", "seeds.count=9", "workers=2", "runs_dir=x", "progress=none")
    assert same.name == "FQI"


def test_a_composition_of_ones_own_gets_a_directory_of_its_own():
    more = plan("env=maze", "algorithm.regressor.trees=100")
    other = plan("env=maze", "algorithm.regressor.trees=101")
    assert more.variant == "FQI" and more.name.startswith("FQI@")
    assert len({more.name, other.name, "FQI"}) == 3
    assert more.name == plan("env=maze", "algorithm.regressor.trees=100").name
    assert plan("env=maze", "tag=mine", "env.preset=paper").name == "FQI@mine"
    # A value that is the default anyway makes no difference.
    assert plan("env=maze", "algorithm.regressor.trees=50").name == "FQI"
    assert plan("env=maze", "budget=maze_fqi").name == "FQI"


def test_options_of_ones_own_never_pass_for_the_shipped_ones(tmp_path, monkeypatch):
    (tmp_path / "algorithm").mkdir()
    shipped = (vetting.CONF / "algorithm" / "fqi.yaml").read_text()
    big = shipped.replace("- regressor: forest", "- regressor: sklearn_forest")
    (tmp_path / "algorithm" / "big.yaml").write_text(big)
    (own,) = plans("env=maze", "algorithm=big", config_dir=str(tmp_path))
    assert own.name.startswith("FQI@")
    monkeypatch.setitem(CURRICULA, "reverse", lambda n: [n - 1 - i for i in range(n)])
    (tmp_path / "curriculum").mkdir()
    (tmp_path / "curriculum" / "reverse.yaml").write_text("name: reverse\n")
    (own,) = plans("env=maze", "curriculum=reverse", config_dir=str(tmp_path))
    assert own.name.startswith("C-FQI@")
    assert [stage.task for stage in own.stages] == list(range(10, 0, -1))


def test_an_experiment_is_its_figures_sweep():
    names = {p.name for p in plans("experiment=fig1")}
    assert names == {"FQI", "C-FQI", "B-FQI", "BC-FQI"}
    assert [p.name for p in plans("experiment=fig5")] == ["BC-FQI"]
    assert {p.name for p in plans("experiment=fig2", "curriculum=on")} == {
        "C-FQI",
        "BC-FQI",
    }
    released = plans("experiment=fig1_released")
    assert all(
        p.tag == "released" and p.shared_data and p.fixed_trees for p in released
    )
    sweep = plans("env=maze", "curriculum=on,off", "boosting=on,off", multirun=True)
    assert {p.name for p in sweep} == names


def outcome(overrides) -> str:
    """How a composition ends; anything but a plan or a reasoned refusal propagates."""
    try:
        return " ".join(p.name for p in plans(*overrides))
    except BcrlError as error:
        assert "=" in str(error) and len(str(error)) > 20, str(error)
        return "refused"


ENV_LESS = [g for g in GROUPS if g not in ("experiment", "env", "budget")]


@pytest.mark.parametrize("env", GROUPS["env"])
@pytest.mark.parametrize("budget", [None, *GROUPS["budget"]])
def test_every_combination_composes_or_is_refused_with_a_reason(env, budget):
    fixed = [f"env={env}"] + ([f"budget={budget}"] if budget else [])
    for options in itertools.product(*(GROUPS[g] for g in ENV_LESS)):
        choice = dict(zip(ENV_LESS, options, strict=True))
        ended = outcome([*fixed, *(f"{g}={o}" for g, o in choice.items())])
        tabular_hill = env == "car_on_hill" and options[-1] == "tabular"
        foreign_budget = env == "car_on_hill" and budget == "maze_fqi"
        foreign_budget |= env == "maze" and budget == "car_on_hill_fqi"
        assert (ended == "refused") == (tabular_hill or foreign_budget), choice


@pytest.mark.parametrize("experiment", GROUPS["experiment"])
def test_every_experiment_composes_at_every_scale_with_every_option(experiment):
    for scale in GROUPS["scale"]:
        for regressor in GROUPS["algorithm/regressor"]:
            chosen = (f"scale={scale}", f"algorithm/regressor={regressor}")
            ended = outcome([f"experiment={experiment}", *chosen])
            refused = regressor == "tabular" and experiment in (
                "fig1",
                "fig1_released",
                "fig2_released",  # its maze leaves the lattice
            )
            assert (ended == "refused") == refused, (scale, regressor, ended)


def test_a_users_folder_adds_options_of_its_own(tmp_path):
    (tmp_path / "experiment").mkdir()
    text = "# @package _global_\ndefaults:\n  - override /env: maze\ntag: mine\n"
    (tmp_path / "experiment" / "mine.yaml").write_text(text)
    (tmp_path / "env").mkdir()
    shipped = (vetting.CONF / "env" / "maze.yaml").read_text()
    low = shipped.replace("0.85, 0.95]", "0.85, 0.9]")
    (tmp_path / "env" / "low_maze.yaml").write_text(low)
    (own,) = plans("experiment=mine", config_dir=str(tmp_path))
    assert own.name == "FQI@mine"
    (tmp_path / "budget").mkdir()
    budget = (vetting.CONF / "budget" / "maze_fqi.yaml").read_text()
    (tmp_path / "budget" / "low_maze_fqi.yaml").write_text(budget)
    (low_maze,) = plans("env=low_maze", "curriculum=on", config_dir=str(tmp_path))
    assert low_maze.directory == Path("runs/quick/low_maze/C-FQI")
    assert low_maze.target.height == 0.9 and low_maze.stages[-1].iterations == 50
