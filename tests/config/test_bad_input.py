"""Bad input ends in one clear message before any work, and leaves nothing behind."""

import shlex
import sys

import pytest
import torch

from bcrl import cli
from bcrl.config.hydra_compose import CONF
from bcrl.config.schema import check_name
from bcrl.errors import BcrlError
from tests.config.helpers import own, rows
from tests.conftest import plan, plans

MAZE = "env=maze"


def test_it_is_rejected_by_key_value_and_what_is_allowed():
    for line, said in rows("bad_input.txt"):
        with pytest.raises(BcrlError) as error:
            plans(*shlex.split(line))
        for words in said.split("; "):
            assert words in str(error.value), line


def test_a_missing_cuda_device_is_rejected():
    if torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    with pytest.raises(BcrlError, match="device=cuda"):
        plan("env=linear_system", "algorithm=dqn", "device=cuda")


def test_what_names_a_directory_is_a_plain_word(tmp_path):
    for name in ("a b", "$(x)", "a,b", "a=b", "-x", ".x", "", "é", "a@b", "#a"):
        with pytest.raises(BcrlError, match=r"tag="):
            check_name("tag", name)
    with pytest.raises(BcrlError, match=r"scale.name=a b"):
        plans(MAZE, "scale.name='a b'")
    folder = own(tmp_path, (CONF / "env" / "maze.yaml").read_text(), "env/my maze")
    with pytest.raises(BcrlError, match="env=my maze: must be a plain name"):
        plans("env='my maze'", config_dir=folder)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("seeds: {count: many}", "seeds.count; many"),
        ("seeds: {cuont: 3}", "seeds.cuont"),
        ("seeds: [", "can't be read; mine.yaml"),
        ("defaults:\n  - override /curriculum: off", "bare off; quote it"),
        ("algorithm: {iterations: 0}", "algorithm.iterations=0"),
        ("env: {horizon: 5:00}", "5:00; 300"),
        ("seeds: {first: 010}", "010; 8"),
        ("seeds: {first: 0x10}", "0x10; 16"),
        ("seeds: [1_0]", "1_0; 10"),
        ("strict: yes", "yes; True"),
        ("transfer: off", "off"),
        ("tag: 1e3", "tag=1000.0"),
        ("tag: 12", "tag=12"),
        ("evn: {gamma: 0.9}", "evn; env: …"),
        ("env.gamma: 0.9", "env: {gamma: …}"),
        ("boosting: 'on'", "boosting"),
        ("variant: BC", "defaults: [override /variant: …]"),
        ("seed: 2\nseeds: 3", "seed=2; seeds"),
        ("scale: {name: 7}", "scale.name=7"),
    ],
)
def test_a_users_yaml_is_checked_too(text, said, tmp_path):
    with pytest.raises(BcrlError) as error:
        plans(MAZE, "experiment=mine", config_dir=own(tmp_path, text))
    for words in said.split("; "):
        assert words in str(error.value)


def test_a_sweep_whose_jobs_would_share_a_directory_is_rejected():
    with pytest.raises(BcrlError, match=r"episodes=5 and algorithm.episodes=6"):
        plans(MAZE, "algorithm.episodes=5,6", "tag=one", multirun=True)


@pytest.mark.parametrize(
    "typed",
    [
        "-m env=maze curriculum=on,of",
        "env=maze runs_dir=a_file/below",
        "env=maze runs_dir=/proc/runs",
        "env=maze --config-dir nowhere",
        "--mutlirun env=maze",
        "env=maze --experimental-rerun x.pickle",
    ],
)
def test_the_command_says_so_exits_nonzero_and_writes_nothing(
    tmp_path, monkeypatch, capsys, typed
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["bcrl", *typed.split()])
    (tmp_path / "a_file").write_text("")
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    said = capsys.readouterr().err
    assert said.startswith("bcrl: ") and "Traceback" not in said
    assert [p.name for p in tmp_path.iterdir()] == ["a_file"]
