"""Composition: names, tags, directories, budgets, and every combination of groups."""

import itertools
from pathlib import Path

import pytest

from bcrl.config.hydra_compose import CONF, catalog
from bcrl.errors import BcrlError
from bcrl.learning.curriculum import CURRICULA
from bcrl.learning.dqn import DQN
from bcrl.learning.lspi import LSPI
from bcrl.learning.transfer import Boost, PolicyReuse, ResidualPolicy, Shape, warm_start
from tests.config.helpers import own
from tests.conftest import plan, plans

MAZE, LINEAR = "env=maze", ("env=linear_system", "algorithm=dqn")


@pytest.mark.parametrize(
    ("curriculum", "boosting", "name", "transfer"),
    [
        ("off", "off", "FQI", warm_start),
        ("on", "off", "C-FQI", warm_start),
        ("off", "on", "B-FQI", Boost()),
        ("on", "on", "BC-FQI", Boost()),
    ],
)
def test_variants_are_named_by_what_they_are(curriculum, boosting, name, transfer):
    p = plan(MAZE, f"curriculum={curriculum}", f"boosting={boosting}")
    assert p.directory == Path("runs/quick/maze", name)
    assert {s.transfers for s in p.stages} == {(transfer,)}
    tasks = [stage.task for stage in p.stages]
    assert tasks == (list(range(1, 11)) if curriculum == "on" else [10] * 10)


def test_the_papers_budgets():
    maze = plan(MAZE, "curriculum=on")
    learners = [stage.learner for stage in maze.stages]
    assert [x.iterations for x in learners] == [10] * 4 + [20] * 2 + [50] * 4
    epsilons = [1] * 4 + [0.75] * 2 + [0.5] * 2 + [0.25] * 2
    assert [x.epsilon for x in learners] == epsilons
    assert {(x.episodes, x.new_data) for x in learners} == {(500, True)}
    assert [s.env.height for s in maze.stages][::9] == [0.05, 0.95]
    hill = plan("env=car_on_hill")
    assert [s.learner.iterations for s in hill.stages] == [20] * 3
    assert [s.learner.new_data for s in hill.stages] == [True, False, False]
    assert [s.env.mass for s in hill.stages] == [1.2] * 3


def test_scales_choose_seeds_and_cap_budgets():
    assert plan(MAZE).seeds == (0, 1, 2)
    assert len(plan(MAZE, "scale=paper").seeds) == 40
    assert len(plan("env=car_on_hill", "scale=paper").seeds) == 20
    smoke = [s.learner for s in plan(MAZE, "scale=smoke").stages]
    assert {(x.iterations, x.episodes) for x in smoke} == {(2, 20)}
    tuned = plans("experiment=search_nu")[0].seeds  # which report nothing
    assert min(tuned) > plan("env=linear_system", "scale=paper").seeds[-1]


def test_a_composition_of_ones_own_gets_a_directory_of_its_own():
    more = plan(MAZE, "algorithm.regressor.trees=100")
    other = plan(MAZE, "algorithm.regressor.trees=101")
    assert more.variant == "FQI" and more.name.startswith("FQI@")
    assert len({more.name, other.name, "FQI"}) == 3
    assert more.name == plan(MAZE, "algorithm.regressor.trees=100").name
    assert plan(MAZE, "tag=mine", "env.preset=paper").name == "FQI@mine"
    assert plan(*LINEAR, "variant=BC", "boosting.maxima=two").name[:7] == "BC-DQN@"
    # A value that is the default anyway, or changes no number, makes no difference.
    outputs = ("seeds.count=9", "workers=2", "runs_dir=x", "progress=none")
    for same in (["algorithm.regressor.trees=50"], ["budget=maze_fqi"], outputs):
        assert plan(MAZE, *same).name == "FQI"


def test_options_of_ones_own_never_pass_for_the_shipped_ones(tmp_path, monkeypatch):
    shipped = (CONF / "algorithm" / "fqi.yaml").read_text()
    big = shipped.replace("- regressor: forest", "- regressor: sklearn_forest")
    folder = own(tmp_path, big, "algorithm/big")
    (made,) = plans(MAZE, "algorithm=big", config_dir=folder)
    assert made.name.startswith("FQI@")
    monkeypatch.setitem(CURRICULA, "reverse", lambda n: [n - 1 - i for i in range(n)])
    own(tmp_path, "name: reverse", "curriculum/reverse")
    (made,) = plans(MAZE, "curriculum=reverse", config_dir=folder)
    assert made.name.startswith("C-FQI@")
    assert [stage.task for stage in made.stages] == list(range(10, 0, -1))


def test_an_experiment_is_its_figures_sweep():
    names = {p.name for p in plans("experiment=fig1")}
    assert names == {"FQI", "C-FQI", "B-FQI", "BC-FQI"}
    assert [p.name for p in plans("experiment=fig5")] == ["BC-FQI"]
    released = plans("experiment=fig1_released")
    assert {p.tag for p in released} == {"released"}
    learners = [s.learner for p in released for s in p.stages]
    assert all(x.shared_data and x.fixed_trees for x in learners)
    sweep = plans(MAZE, "curriculum=on,off", "boosting=on,off", multirun=True)
    assert {p.name for p in sweep} == names


def outcome(*overrides: str) -> str:
    """How a composition ends; any error but a reasoned rejection propagates."""
    try:
        return " ".join(p.name for p in plans(*overrides))
    except BcrlError as error:
        assert "=" in str(error) and len(str(error)) > 20, str(error)
        return "rejected"


def sensible(algorithm: str, curriculum: str, boosting: str, transfer: str) -> bool:
    """Whether docs/architecture.md says that this combination runs."""
    steered = transfer in ("policy_reuse", "residual_policy")
    if algorithm == "fqi":
        return not steered and "released" not in boosting + transfer
    twice = transfer == "residual_policy" and boosting != "off"
    return not twice and not (steered and curriculum == "off")


@pytest.mark.parametrize(
    "algorithm", ["dqn", pytest.param("fqi", marks=pytest.mark.slow)]
)
def test_every_combination_composes_or_is_rejected_with_a_reason(algorithm):
    """The rule book's test (test_rule_book.py) has all envs without composing."""
    groups, names = ("curriculum", "boosting", "transfer"), {}
    for chosen in itertools.product(*(catalog()[group] for group in groups)):
        words = [f"{group}={o}" for group, o in zip(groups, chosen, strict=True)]
        ended = outcome("env=linear_system", f"algorithm={algorithm}", *words)
        assert (ended != "rejected") == sensible(algorithm, *chosen), chosen
        names.setdefault(ended, []).append(chosen)
    del names["rejected"]
    # A name means one thing, and a mixture of readings has a separate directory.
    assert all(len(chosen) == 1 for chosen in names.values()), names


@pytest.mark.slow
def test_every_experiment_and_every_scale_composes():
    chosen = [(experiment, "paper") for experiment in catalog()["experiment"]]
    for experiment, scale in [*chosen, *(("fig5", x) for x in catalog()["scale"])]:
        assert outcome(f"experiment={experiment}", f"scale={scale}") != "rejected"


RELEASED = (Boost("residual", "two", False), Shape("before_reset", False))
SEARCHED = (Boost(alpha="search"), Shape())
#: Of each variant: its name, transfers, learners and last target_update.
VARIANTS = {
    "plain": ("DQN", (warm_start,), [DQN], 200),
    "C": ("C-DQN", (warm_start,), [DQN, DQN], 25),
    "B": ("B-DQN", (Boost(),), [DQN, DQN], 2000),
    "BC": ("BC-DQN", (Boost(),), [LSPI, DQN], 2000),
    "SC": ("SC-DQN", (Shape(),), [LSPI, DQN], 4000),
    "SBC": ("SBC-DQN", (Boost(), Shape()), [LSPI, DQN], 4000),
    "RPL": ("RPL", (ResidualPolicy(2000),), [LSPI, DQN], 25),
    "PPR": ("PPR", (PolicyReuse(0.998),), [LSPI, DQN], 200),
    "BC_released": ("BC-DQN@released", RELEASED[:1], [LSPI, DQN], 2000),
    "SC_released": ("SC-DQN@released", RELEASED[1:], [LSPI, DQN], 4000),
    "SBC_released": ("SBC-DQN@released", RELEASED, [LSPI, DQN], 4000),
    "B_line_search": ("B-DQN@line_search", SEARCHED[:1], [DQN, DQN], 2000),
    "BC_line_search": ("BC-DQN@line_search", SEARCHED[:1], [LSPI, DQN], 2000),
    "SBC_line_search": ("SBC-DQN@line_search", SEARCHED, [LSPI, DQN], 4000),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_linear_systems_methods(variant):
    name, transfers, learners, target_update = VARIANTS[variant]
    p = plan(*LINEAR, f"variant={variant}")
    assert p.name == name and p.family == "DQN"
    assert [type(s.learner) for s in p.stages] == learners
    assert p.stages[-1].transfers == transfers
    assert p.stages[-1].learner.target_update == target_update
    random = sum(getattr(s.learner, "random_steps", 0) for s in p.stages)
    assert p.length == 40_000 + random
    without = ("plain", "C", "SC", "SC_released", "B", "B_line_search")
    assert random == (500 if variant in without else 0)


def test_choosing_the_groups_is_the_same_as_naming_the_variant():
    for named, groups in (
        ("BC", "curriculum=on boosting=on"),
        ("SBC_released", "curriculum=on boosting=released transfer=shaping_released"),
        ("PPR", "curriculum=on transfer=policy_reuse"),
    ):
        here, there = plan(*LINEAR, f"variant={named}"), plan(*LINEAR, *groups.split())
        assert (here.name, here.stages) == (there.name, there.stages)
        assert plan(*LINEAR, f"variant={named}", *groups.split()).name == here.name
    sb = plan(*LINEAR, "boosting=on", "transfer=shaping")
    assert sb.variant == "SB-DQN" and {s.task for s in sb.stages} == {2}


def test_a_users_folder_adds_options_of_its_own(tmp_path):
    folder = own(tmp_path, "defaults:\n  - override /env: maze\ntag: mine")
    (p,) = plans("experiment=mine", config_dir=folder)
    assert p.name == "FQI@mine"
    shipped = (CONF / "env" / "maze.yaml").read_text()
    own(tmp_path, shipped.replace("0.85, 0.95]", "0.85, 0.9]"), "env/low_maze")
    budget = (CONF / "budget" / "maze_fqi.yaml").read_text()
    own(tmp_path, budget, "budget/low_maze_fqi")
    (p,) = plans("env=low_maze", "curriculum=on", config_dir=folder)
    assert p.directory == Path("runs/quick/low_maze/C-FQI")
    assert p.target.height == 0.9 and p.stages[-1].learner.iterations == 50
