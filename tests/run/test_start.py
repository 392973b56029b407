"""A run that starts from another run's agents equals one that learned all tasks."""

import numpy as np
import pytest

import bcrl
from bcrl.errors import BcrlError, ConfigError
from bcrl.results import verify
from bcrl.results.tasks import numbered_tasks
from tests.conftest import plan
from tests.run.runs import DQN, HILL, MAZE, compared, rows, run

ONE = ("curriculum=off", "boosting=off", "transfer=none")


def hill(*masses: float) -> tuple[str, ...]:
    return (
        *HILL,
        "algorithm.iterations=3",
        f"env.tasks.mass=[{','.join(map(str, masses))}]",
    )


@pytest.mark.parametrize("variant", ["C", "BC", "SC"])
def test_fqi_in_two_runs_equals_the_curriculum_in_one(variant, tmp_path):
    words = (f"variant={variant}",)
    whole = run(tmp_path / "whole", *hill(0.8, 1.0, 1.2), *words)
    first = run(tmp_path / "first", *hill(0.8))
    start = f"start.from={first.directory}"
    second = run(tmp_path / "second", *hill(1.0, 1.2), *words, start)
    assert second.variant == whole.variant
    assert [verify.main([str(folder)]) for folder in tmp_path.iterdir()] == [0, 0, 0]
    for seed in (0, 1):
        assert rows(first, seed) + rows(second, seed) == rows(whole, seed)
        one, other = (bcrl.load(p.directory, seed) for p in (second, whole))
        x = np.random.default_rng(0).uniform([-1, -3], [1, 3], (500, 2))
        assert (one.q(x) == other.q(x)).all()


@pytest.mark.parametrize(
    "variant", ["BC", "SC", "SBC_released", "SBC_line_search", "RPL", "PPR", "C"]
)
def test_dqn_in_two_runs_equals_the_curriculum_in_one(variant, tmp_path):
    words = (*DQN, f"variant={variant}")
    whole = run(tmp_path / "whole", *words)
    lists = whole.config["algorithm"].items()
    lists = [(k, v) for k, v in lists if isinstance(v, list) and k != "hidden"]
    easy, hard = ([f"algorithm.{k}={v[slot]}" for k, v in lists] for slot in (0, 1))
    easy += ["env.tasks.task=[lq]", "env.tasks.horizon=[100]"]
    hard += ["env.tasks.task=[target]", "env.tasks.horizon=[150]"]
    if variant != "C":
        easy.append("algorithm.learners=lspi")
    first = run(tmp_path / "first", *DQN, *easy)
    start = f"start.from={first.directory}"
    second = run(tmp_path / "second", *words, *hard, start)
    assert second.variant == whole.variant
    made, expected = rows(second, 1), rows(whole, 1)
    assert [*map(str, made)] == [*map(str, expected[-len(made) :])]
    one, other = (bcrl.load(p.directory, 1) for p in (second, whole))
    x = np.random.default_rng(0).normal(size=(500, 4))
    assert (one.q(x) == other.q(x)).all()


def test_a_third_run_starts_from_the_second(tmp_path):
    whole = run(tmp_path / "whole", *hill(0.8, 1.0, 1.2), "variant=BC")
    first = run(tmp_path / "a", *hill(0.8))
    second = run(
        tmp_path / "b", *hill(1.0), "boosting=on", f"start.from={first.directory}"
    )
    third = run(
        tmp_path / "c", *hill(1.2), "boosting=on", f"start.from={second.directory}"
    )
    made = [row for p in (first, second, third) for row in rows(p, 0)]
    assert made == rows(whole, 0)
    tasks, target = numbered_tasks(third.config)
    assert [task.values["mass"] for task in tasks] == [0.8, 1.0, 1.2] and target == 3
    first.directory.rename(tmp_path / "elsewhere")
    assert len(bcrl.load(third.directory).residuals) == 1


def test_a_moved_folder_is_the_same_run(tmp_path):
    first = run(tmp_path / "a", *hill(0.8))
    words = (*hill(1.2), "boosting=on")
    second = run(tmp_path / "b", *words, f"start.from={first.directory}")
    moved = tmp_path / "elsewhere" / "smoke" / "car_on_hill" / first.name
    moved.parent.mkdir(parents=True)
    first.directory.rename(moved)
    again = run(tmp_path / "b", *words, f"start.from={moved}")
    assert compared(second, again) is None


def test_observations_are_mapped_for_the_earlier_agents(tmp_path):
    first = run(tmp_path / "first", *hill(0.8))
    words = (*hill(1.2), "variant=BC", f"start.from={first.directory}")
    plain = run(tmp_path / "plain", *words)
    mapped = run(tmp_path / "mapped", *words, "start.observation=tests.toys.same")
    assert rows(mapped, 1) == rows(plain, 1)
    x = np.random.default_rng(0).uniform([-1, -3], [1, 3], (500, 2))
    agent = bcrl.load(mapped.directory, 1, trust="tests")
    assert (agent.q(x) == bcrl.load(plain.directory, 1).q(x)).all()


def test_what_a_run_cant_start_from_is_refused(tmp_path):
    first = run(tmp_path / "a", *hill(0.8))
    kept = f"start.from={first.directory}"
    for words, why in (
        ((*hill(1.2), "start.from=nowhere"), "holds no run"),
        ((*MAZE, kept), "n_actions is 2"),
        ((*hill(1.2), "start.observation=a.b"), "name it: start.from="),
    ):
        with pytest.raises((ConfigError, BcrlError), match=why):
            plan(*words)
    with pytest.raises(ConfigError, match="no agents of seeds 2"):
        run(tmp_path / "b", *hill(1.2), kept, "seeds=3")
