"""Environments of other packages learn (docs/howto/other_packages.md)."""

import importlib.util
import os
import re
import shlex
from pathlib import Path

import pytest

from bcrl.run import records, runner
from tests.conftest import plans

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "other_packages.md"
SECTION = PAGE.read_text(encoding="utf-8")
COMMANDS = {
    re.search(r"env\.id=(?:\w+:)?(\S+)", line)[1]: shlex.split(line)
    for line in re.findall(r"^bcrl .*$", SECTION, re.M)
}
#: The module that an environment needs besides Gymnasium, by its name's beginning.
MODULES = {"Lunar": "Box2D", "Biped": "Box2D", "MiniGrid": "minigrid", "ALE": "ale_py"}
#: CI sets this, so that a missing package is a failure there.
REQUIRED = os.environ.get("BCRL_ENVIRONMENTS") == "required"
#: Less than scale=smoke, which takes minutes for all of them.
SMALLER = ("scale.max_episodes=2", "scale.max_steps=20", "env.starts=1")
SMALLER += ("env.horizon=20", "seeds.count=1", "progress=none")
OWN = {"fqi": ["algorithm.regressor.trees=2"], "dqn": ["algorithm.random_steps=10"]}
OWN["dqn"] += ["algorithm.learning_starts=15", "algorithm.evaluation_episodes=1"]


def test_the_page_has_a_command_and_a_row_for_each():
    rows = re.findall(r"^\| ([\w/-]+-v\d+) \|", SECTION, re.M)
    assert rows == list(COMMANDS) and len(rows) == 10


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_fqi_and_dqn_learn_it_plain_and_with_a_boosted_curriculum(name, tmp_path):
    for begins, module in MODULES.items():
        missing = name.startswith(begins) and not importlib.util.find_spec(module)
        if missing and not REQUIRED:
            pytest.skip(f"{module} isn't installed: the extra `environments` has it")
    _, multirun, *overrides = COMMANDS[name]
    assert multirun == "-m"
    overrides = [o for o in overrides if not o.startswith("env.horizon=")]
    overrides.remove("algorithm=fqi,dqn")  # their budgets differ
    overrides += [*SMALLER, f"runs_dir={tmp_path}"]
    made = []
    for algorithm, own in OWN.items():
        made += plans(*overrides, f"algorithm={algorithm}", *own, multirun=True)
    assert [p.variant for p in made] == ["FQI", "BC-FQI", "DQN", "BC-DQN"]
    assert all(len(p.tasks) == 2 and p.tasks[0] != p.target for p in made)
    runner.run(*made)
    assert not any(records.pending(p, [0]) for p in made)
