"""Bad input ends in one clear message before any work, and leaves nothing behind."""

import sys

import pytest

from bcrl import cli
from bcrl.config.hydra_compose import CONF
from bcrl.config.schema import check_name
from bcrl.errors import BcrlError
from tests.conftest import plans

MAZE = "env=maze"
BAD = {
    "unknown env": (["env=maz"], ["env=maz", "did you mean env=maze?"]),
    "no env": ([], ["You must specify 'env'", "maze"]),
    "unknown regressor": (
        [MAZE, "algorithm/regressor=forst"],
        ["algorithm/regressor=forest?"],
    ),
    "unknown preset": ([MAZE, "env.preset=relesed"], ["mean released?"]),
    "unknown metric": ([MAZE, "env.metrics=[retrun]"], ["retrun", "return"]),
    "unknown group": ([MAZE, "boostign=on"], ["boostign", "boosting"]),
    "unknown key": ([MAZE, "seeds.cuont=1"], ["seeds.cuont", "seeds.count"]),
    "added key": (
        [MAZE, "+env.hieght=0.5"],
        ["env.hieght=0.5", "unknown key", "height"],
    ),
    "another option's key": (
        [MAZE, "transfer.nu=0.9"],
        ["transfer.nu: unknown key", "transfer=policy_reuse transfer.nu=0.9"],
    ),
    "nearly another option's key": (
        [MAZE, "algorithm.lspi.iterrations=1"],
        ["did you mean algorithm=dqn algorithm.lspi.iterations=1?"],
    ),
    "another regressor's key": (
        [MAZE, "algorithm/regressor=tabular", "algorithm.regressor.trees=9"],
        ["algorithm/regressor=forest algorithm.regressor.trees=9"],
    ),
    "a group's typo": (
        [MAZE, "algorithm/regresor=forest"],
        ["algorithm/regressor=forest?"],
    ),
    "unknown experiment": (["experiment=fgi1"], ["did you mean experiment=fig1?"]),
    "unknown local": ([MAZE, "local=hoem"], ["local=hoem", "none"]),
    "an option with a dot": (
        [MAZE, "algorithm.regressor=tabular"],
        ["did you mean algorithm/regressor=tabular?"],
    ),
    "no seeds": ([MAZE, "seeds.count=0"], ["seeds.count=0", "from 1 to"]),
    "negative seed": ([MAZE, "seeds.first=-1"], ["seeds.first=-1", "from 0 to"]),
    "no workers": ([MAZE, "workers=0"], ["workers=0", "at least 1"]),
    "no threads": ([MAZE, "threads=0"], ["threads=0", "at least 1"]),
    "wrong type": ([MAZE, "seeds.count=many"], ["seeds.count=many", "Integer"]),
    "fractional": ([MAZE, "algorithm.iterations=2.5"], ["iterations=2.5", "integer"]),
    "text": ([MAZE, "algorithm.episodes=lots"], ["episodes=lots", "integer"]),
    "boolean": ([MAZE, "algorithm.iterations=true"], ["iterations=True", "integer"]),
    "negative budget": ([MAZE, "algorithm.iterations=-3"], ["-3", "at least 1"]),
    "negative in a list": (
        ["env=car_on_hill", "algorithm.iterations=[1,2,-3]"],
        ["algorithm.iterations=-3", "at least 1"],
    ),
    "list of wrong length": (
        [MAZE, "algorithm.iterations=[1,2]"],
        ["algorithm.iterations=[1, 2]", "2 entries", "10 tasks"],
    ),
    "epsilon": ([MAZE, "algorithm.epsilon=1.5"], ["algorithm.epsilon=1.5", "0 to 1"]),
    "not a number": ([MAZE, "env.gamma=nan"], ["env.gamma"]),
    "gamma": ([MAZE, "env.gamma=1.0"], ["env.gamma=1.0", "[0, 1)"]),
    "height": ([MAZE, "env.tasks.height=[0.5,1.5]"], ["env.height=1.5", "[0, 1)"]),
    "mass": (["env=car_on_hill", "env.tasks.mass=[0,1]"], ["env.mass=0"]),
    "no tasks": ([MAZE, "env.tasks.height=[]"], ["env.tasks", "one value per task"]),
    "trees": (
        [MAZE, "algorithm.regressor.trees=0"],
        ["regressor.trees=0", "at least 1"],
    ),
    "curriculum of one": (
        [MAZE, "env.tasks.height=[0.5]", "curriculum=on"],
        ["curriculum=on", "one task"],
    ),
    "boosting of one": (
        [MAZE, "env.tasks.height=[0.5]", "boosting=on"],
        ["boosting=on", "one task"],
    ),
    "table of a continuum": (
        ["env=car_on_hill", "algorithm/regressor=tabular"],
        ["tabular", "finitely many states"],
    ),
    "shared but own data": (
        [MAZE, "algorithm.dataset=shared"],
        ["algorithm.dataset=shared", "epsilon must be 1"],
    ),
    "sweep without -m": ([MAZE, "curriculum=on,off"], ["curriculum", "-m"]),
    "two experiments": (["experiment=[fig1,fig2]"], ["experiment", "name one option"]),
    "swept experiments": (["experiment=fig1,fig2"], ["experiment", "add -m"]),
    "unknown budget": ([MAZE, "budget=maze_fqy"], ["budget=maze_fqy", "maze_fqi"]),
    "swept budgets": (
        [MAZE, "budget=maze_fqi,nope"],
        ["budget", "no nope"],
    ),
    "added key on top": ([MAZE, "+iterations=3"], ["iterations=3", "unknown key"]),
    "a task's key twice": ([MAZE, "+env.height=0.3"], ["env.height=0.3", "env.tasks"]),
    "added to a choice": (
        [MAZE, "+curriculum.foo=null"],
        ["curriculum.foo", "unknown"],
    ),
    "deleted group": ([MAZE, "~transfer"], ["transfer", "needs a choice"]),
    "a number for an option": ([MAZE, "algorithm=2.5"], ["algorithm=2.5", "fqi"]),
    "a list of options": ([MAZE, "variant=[1]"], ["variant=[1]", "name one option"]),
    "metric no name": ([MAZE, "env.metrics=[[return]]"], ["env.metrics"]),
    "no searchpath": ([MAZE, "hydra.searchpath=[/no/where]"], ["/no/where"]),
    "unspeakable tag": ([MAZE, "tag=a/b"], ["tag=a/b", "letters"]),
    "no override": ([MAZE, "curriculum on"], ["KEY=VALUE"]),
}


def test_it_is_rejected_by_key_value_and_what_is_allowed():
    for case, (overrides, expected) in BAD.items():
        with pytest.raises(BcrlError) as error:
            plans(*overrides)
        for words in expected:
            assert words in str(error.value), case


def test_a_folder_is_looked_for_among_its_neighbours(tmp_path):
    (tmp_path / "my_configs").mkdir()
    with pytest.raises(BcrlError, match=r"did you mean my_configs\?"):
        plans(MAZE, config_dir=str(tmp_path / "my_conifgs"))


def test_what_names_a_directory_is_a_plain_word():
    for name in ("a b", "a;b", "$(x)", "a,b", "a=b", "-x", ".x", "", "é", "a@b", "#a"):
        with pytest.raises(BcrlError, match=r"tag="):
            check_name("tag", name)
    for key in ("tag", "scale.name"):
        with pytest.raises(BcrlError, match=f"{key}=a b"):
            plans(MAZE, f"{key}='a b'")


def test_an_env_is_a_plain_name_too(tmp_path):
    (tmp_path / "env").mkdir()
    text = (CONF / "env" / "maze.yaml").read_text()
    (tmp_path / "env" / "my maze.yaml").write_text(text)
    with pytest.raises(BcrlError, match="env=my maze: must be a plain name"):
        plans("env='my maze'", config_dir=str(tmp_path))


YAMLS = {
    "wrong type": ("seeds: {count: many}", ["seeds.count", "many"]),
    "unknown key": ("seeds: {cuont: 3}", ["seeds.cuont"]),
    "no yaml": ("seeds: [", ["can't be read", "mine.yaml"]),
    "bare off": ("defaults:\n  - override /curriculum: off", ["quote on and off"]),
    "bad budget": ("algorithm: {iterations: 0}", ["algorithm.iterations=0"]),
}


def test_a_users_yaml_is_checked_too(tmp_path):
    for case, (text, expected) in YAMLS.items():
        place = tmp_path / case / "experiment"
        place.mkdir(parents=True)
        (place / "mine.yaml").write_text(f"# @package _global_\n{text}\n")
        with pytest.raises(BcrlError) as error:
            plans(MAZE, "experiment=mine", config_dir=str(place.parent))
        for words in expected:
            assert words in str(error.value), case


def test_a_sweep_whose_jobs_would_share_a_directory_is_rejected():
    with pytest.raises(
        BcrlError, match=r"algorithm.episodes=5 and algorithm.episodes=6"
    ):
        plans(MAZE, "algorithm.episodes=5,6", "tag=one", multirun=True)


@pytest.mark.parametrize(
    "arguments",
    [
        ["env=maz"],
        ["-m", "env=maze", "curriculum=on,of"],
        ["env=maze", "runs_dir=a_file/below"],
        ["env=maze", "runs_dir=/proc/runs"],
        ["env=maze", "--config-dir", "nowhere"],
        ["--mutlirun", "env=maze"],
        ["env=maze", "--experimental-rerun", "x.pickle"],
    ],
)
def test_the_command_says_so_exits_nonzero_and_writes_nothing(
    tmp_path, monkeypatch, capsys, arguments
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["bcrl", *arguments])
    (tmp_path / "a_file").write_text("")
    with pytest.raises(SystemExit) as ended:
        cli.main()
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert said.startswith("bcrl: ") and "Traceback" not in said
    assert [p.name for p in tmp_path.iterdir()] == ["a_file"]
