"""Composition: names, tags, directories, budgets, and every combination of groups."""

import itertools
from pathlib import Path

import pytest
import yaml

from bcrl.config import jobs
from bcrl.config.hydra_compose import CONF
from bcrl.errors import BcrlError
from bcrl.learning.curriculum import CURRICULA
from bcrl.learning.dqn import DQN
from bcrl.learning.lspi import LSPI
from bcrl.learning.transfer import Boost, PolicyReuse, ResidualPolicy, Shape, warm_start
from tests.conftest import plan, plans

GROUPS = {
    group: sorted(p.stem for p in (CONF / group).glob("*.yaml"))
    for group in (
        *jobs.VARIANT_GROUPS,
        "algorithm/regressor",
        "budget",
        "variant",
        "experiment",
    )
}
#: What stands by itself; the other env wants an id (tests/test_gymnasium.py).
ENVS = [env for env in GROUPS["env"] if env != jobs.OPEN]


@pytest.mark.parametrize(
    ("curriculum", "boosting", "name", "transfer"),
    [
        ("off", "off", "FQI", warm_start),
        ("on", "off", "C-FQI", warm_start),
        ("off", "on", "B-FQI", Boost()),
        ("on", "on", "BC-FQI", Boost()),
    ],
)
@pytest.mark.parametrize("env", ["car_on_hill", "maze"])
def test_variants_are_named_by_what_they_are(env, curriculum, boosting, name, transfer):
    p = plan(f"env={env}", f"curriculum={curriculum}", f"boosting={boosting}")
    assert p.name == name and {s.transfers for s in p.stages} == {(transfer,)}
    assert p.directory == Path("runs/quick") / env / name
    tasks = [stage.task for stage in p.stages]
    n = len(p.tasks)
    assert tasks == (list(range(1, n + 1)) if curriculum == "on" else [n] * n)


def test_the_papers_budgets():
    maze = plan("env=maze", "curriculum=on")
    assert [s.learner.iterations for s in maze.stages] == [10] * 4 + [20] * 2 + [50] * 4
    assert [s.learner.epsilon for s in maze.stages] == [1] * 4 + [0.75] * 2 + [
        0.5
    ] * 2 + [0.25] * 2
    assert {s.learner.episodes for s in maze.stages} == {500}
    assert all(s.learner.new_data for s in maze.stages)
    assert [s.env.height for s in maze.stages][::9] == [0.05, 0.95]
    hill = plan("env=car_on_hill")
    assert [s.learner.iterations for s in hill.stages] == [20] * 3
    assert [s.learner.new_data for s in hill.stages] == [True, False, False]
    assert [s.env.mass for s in hill.stages] == [1.2] * 3
    assert all(
        s.learner.new_data
        for s in plan("env=car_on_hill", "curriculum=on", "boosting=on").stages
    )


def test_scales_choose_seeds_and_cap_budgets():
    assert plan("env=maze").seeds == (0, 1, 2)
    assert len(plan("env=maze", "scale=paper").seeds) == 40
    assert len(plan("env=car_on_hill", "scale=paper").seeds) == 20
    assert plan("env=maze", "seeds.first=5", "seeds.count=2").seeds == (5, 6)
    smoke = plan("env=maze", "scale=smoke")
    assert {(s.learner.iterations, s.learner.episodes) for s in smoke.stages} == {
        (2, 20)
    }


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
    shipped = (CONF / "algorithm" / "fqi.yaml").read_text()
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
        p.tag == "released" and s.learner.shared_data and s.learner.fixed_trees
        for p in released
        for s in p.stages
    )
    sweep = plans("env=maze", "curriculum=on,off", "boosting=on,off", multirun=True)
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
    if steered and curriculum == "off":
        return False
    if transfer == "residual_policy" and boosting != "off":
        return False
    if algorithm == "fqi":
        return not steered and "released" not in boosting + transfer
    return True


@pytest.mark.parametrize(
    ("env", "algorithm"),
    [
        (env, algorithm)
        if env == "linear_system" and algorithm == "dqn"
        else pytest.param(env, algorithm, marks=pytest.mark.slow)
        for env in ENVS
        for algorithm in GROUPS["algorithm"]
    ],
)
def test_every_combination_composes_or_is_rejected_with_a_reason(env, algorithm):
    """The rule book's test (test_rule_book.py) has all of them without composing."""
    groups = ("curriculum", "boosting", "transfer")
    names = {}
    for options in itertools.product(*(GROUPS[g] for g in groups)):
        chosen = [f"{g}={o}" for g, o in zip(groups, options, strict=True)]
        ended = outcome(f"env={env}", f"algorithm={algorithm}", *chosen)
        assert (ended != "rejected") == sensible(algorithm, *options), options
        names.setdefault(ended, []).append(options)
    del names["rejected"]
    # A name means one thing, and a mixture of readings has a separate directory.
    assert all(len(options) == 1 for options in names.values()), names


@pytest.mark.slow
@pytest.mark.parametrize("env", ENVS)
def test_every_regressor_and_budget_composes_or_is_rejected_with_a_reason(env):
    for regressor in GROUPS["algorithm/regressor"]:
        ended = outcome(f"env={env}", f"algorithm/regressor={regressor}")
        assert (ended == "rejected") == (regressor == "tabular" and env != "maze")
    n_tasks = len(plan(f"env={env}").tasks)
    for budget in GROUPS["budget"]:
        algorithm = budget.rsplit("_", 1)[1]
        ended = outcome(f"env={env}", f"algorithm={algorithm}", f"budget={budget}")
        values = yaml.safe_load((CONF / f"budget/{budget}.yaml").read_text())
        lengths = {len(value) for value in values.values() if isinstance(value, list)}
        assert (ended != "rejected") == (lengths <= {n_tasks}), budget


@pytest.mark.slow
def test_every_experiment_composes_at_every_scale():
    for experiment in GROUPS["experiment"]:
        for scale in GROUPS["scale"]:
            assert outcome(f"experiment={experiment}", f"scale={scale}") != "rejected"


DQN_VARIANTS = {
    "plain": ("DQN", (), [DQN]),
    "C": ("C-DQN", (warm_start,), [DQN, DQN]),
    "BC": ("BC-DQN", (Boost(),), [LSPI, DQN]),
    "SC": ("SC-DQN", (Shape(),), [LSPI, DQN]),
    "SBC": ("SBC-DQN", (Boost(), Shape()), [LSPI, DQN]),
    "RPL": ("RPL", (ResidualPolicy(2000),), [LSPI, DQN]),
    "PPR": ("PPR", (PolicyReuse(0.998),), [LSPI, DQN]),
    "BC_released": ("BC-DQN@released", (Boost("residual", "two", False),), [LSPI, DQN]),
    "SC_released": ("SC-DQN@released", (Shape("before_reset", False),), [LSPI, DQN]),
    "SBC_released": (
        "SBC-DQN@released",
        (Boost("residual", "two", False), Shape("before_reset", False)),
        [LSPI, DQN],
    ),
    "B": ("B-DQN", (Boost(),), [DQN, DQN]),
}
TARGET_UPDATE = {"plain": 200, "C": 25, "RPL": 25, "PPR": 200}


@pytest.mark.parametrize("variant", DQN_VARIANTS)
def test_the_linear_systems_methods(variant):
    name, transfers, learners = DQN_VARIANTS[variant]
    p = plan("env=linear_system", "algorithm=dqn", f"variant={variant}")
    assert p.name == name and p.family == "DQN"
    assert [type(s.learner) for s in p.stages] == learners
    assert p.stages[-1].transfers == (transfers or (warm_start,))
    last = p.stages[-1].learner
    usual = 4000 if "S" in variant else 2000
    assert last.target_update == TARGET_UPDATE.get(variant, usual)
    random = sum(getattr(s.learner, "random_steps", 0) for s in p.stages)
    assert p.length == 40_000 + random
    assert random == (500 if variant in ("plain", "C", "SC", "SC_released", "B") else 0)


def test_choosing_the_groups_is_the_same_as_naming_the_variant():
    for named, groups in (
        ("BC", ("curriculum=on", "boosting=on")),
        (
            "SBC_released",
            ("curriculum=on", "boosting=released", "transfer=shaping_released"),
        ),
        ("PPR", ("curriculum=on", "transfer=policy_reuse")),
    ):
        here = plan("env=linear_system", "algorithm=dqn", f"variant={named}")
        there = plan("env=linear_system", "algorithm=dqn", *groups)
        assert (here.name, here.stages) == (there.name, there.stages)
    one = ("env=linear_system", "algorithm=dqn", "variant=BC", "boosting.maxima=two")
    assert plan(*one).name.startswith("BC-DQN@")


def test_a_tuning_seed_reports_nothing():
    tuned = {s for p in plans("experiment=search_nu") for s in p.seeds}
    assert tuned and not tuned & set(
        range(plan("env=linear_system", "scale=paper").seeds[-1] + 1)
    )


def test_a_users_folder_adds_options_of_its_own(tmp_path):
    (tmp_path / "experiment").mkdir()
    text = "# @package _global_\ndefaults:\n  - override /env: maze\ntag: mine\n"
    (tmp_path / "experiment" / "mine.yaml").write_text(text)
    (tmp_path / "env").mkdir()
    shipped = (CONF / "env" / "maze.yaml").read_text()
    low = shipped.replace("0.85, 0.95]", "0.85, 0.9]")
    (tmp_path / "env" / "low_maze.yaml").write_text(low)
    (own,) = plans("experiment=mine", config_dir=str(tmp_path))
    assert own.name == "FQI@mine"
    (tmp_path / "budget").mkdir()
    budget = (CONF / "budget" / "maze_fqi.yaml").read_text()
    (tmp_path / "budget" / "low_maze_fqi.yaml").write_text(budget)
    (low_maze,) = plans("env=low_maze", "curriculum=on", config_dir=str(tmp_path))
    assert low_maze.directory == Path("runs/quick/low_maze/C-FQI")
    assert (
        low_maze.target.height == 0.9 and low_maze.stages[-1].learner.iterations == 50
    )
