"""Every key has a description with its default, unit and allowed values."""

import itertools

import pytest
import yaml
from omegaconf import OmegaConf

from bcrl.common.identity import flat
from bcrl.config import describe
from bcrl.config.hydra_compose import CONF, composed, options
from bcrl.errors import BcrlError

ENTRIES = describe.entries()
#: Keys with a free text as value.
FREE_TEXT = (
    *("name", "partition", "account", "qos", "constraint", "exclude", "gres"),
    *("comment", "submitit_folder"),
)
REGRESSORS, TRANSFERS = options("algorithm/regressor", ()), options("transfer", ())


def keys(*overrides: str) -> set[str]:
    config = composed("config", overrides, ())
    return set(flat(OmegaConf.to_container(config)))


@pytest.mark.parametrize("env", options("env", ()))
def test_every_key_of_every_composition_is_described(env):
    found = set()
    for algorithm in ("fqi", "dqn"):
        chosen = (f"env={env}", f"algorithm={algorithm}")
        if env == "gymnasium":
            chosen += ("env.id=CartPole-v1",)
        found |= keys(*chosen)
    known = {entry.key for entry in ENTRIES if entry.parts[0]}
    assert {k for k in found if not k.startswith("hydra.")} <= known


def test_every_key_of_the_other_groups_is_described():
    found = set()
    for name in REGRESSORS:
        found |= keys("env=maze", f"algorithm/regressor={name}")
    for boosting, transfer in itertools.zip_longest(
        ("off", "on", "released"), TRANSFERS
    ):
        found |= keys(
            "env=maze", f"boosting={boosting or 'off'}", f"transfer={transfer}"
        )
    known = {entry.key for entry in ENTRIES if entry.parts[0]}
    assert {k for k in found if not k.startswith("hydra.")} <= known
    slurm = yaml.safe_load((CONF / "hydra" / "launcher" / "slurm.yaml").read_text())
    assert {f"hydra.launcher.{key}" for key in slurm if key != "_target_"} <= known


def test_comments_have_all_their_parts():
    for entry in ENTRIES:
        text, unit, allowed = entry.parts
        assert text[0].isupper() and text.endswith("."), entry
        assert "Unit" not in text + unit and "Allowed" not in text + unit, entry
        assert allowed or entry.key.rpartition(".")[2] in FREE_TEXT, entry


@pytest.mark.parametrize(
    ("key", "default", "unit", "allowed"),
    [
        ("env.tasks.mass", "[0.8, 1.0, 1.2]", "kg", "> 0"),
        ("algorithm.batch_size", "32", "transitions", "≥ 1"),
        ("checkpoint_every", "60", "seconds", "> 0"),
    ],
)
def test_a_description_has_default_unit_and_allowed_values(key, default, unit, allowed):
    lines = [line.strip() for line in describe.describe(key).splitlines()]
    for line in (key, f"Default: {default}.", f"Unit: {unit}.", f"Allowed: {allowed}."):
        assert line in lines


def test_the_command_prints_it(bcrl):
    done = bcrl("--describe", "transfer.nu=0.9")
    assert done.stdout == describe.describe("transfer.nu") + "\n", done.stderr
    assert "Default: 0.998." in done.stdout


def test_defaults_differ_between_options_and_environments():
    (gamma,) = (e for e in ENTRIES if e.key == "env.gamma")
    assert gamma.defaults["car_on_hill"] == 0.95 and gamma.defaults["maze"] == 0.99
    (iterations,) = (e for e in ENTRIES if e.key == "algorithm.iterations")
    assert iterations.defaults["fqi"] == 20
    assert iterations.defaults["env=car_on_hill"] == [20, 20, 20]


def test_one_key_may_mean_two_things():
    text = describe.describe("env.preset")
    assert "env=maze" in text and "env=linear_system" in text


def test_a_group_lists_its_options_and_a_section_its_keys():
    assert "variant=SBC: " in describe.describe("variant")
    assert "boosting=released: " in describe.describe("boosting")
    assert "seeds.count: " in describe.describe("seeds")
    assert len(describe.describe("").splitlines()) == len({e.key for e in ENTRIES})


@pytest.mark.parametrize(
    ("typed", "meant"),
    [("env.gama", "env.gamma"), ("lr", "algorithm.learning_rate"), ("xyzzy", None)],
)
def test_an_unknown_key_gets_a_suggestion(typed, meant):
    with pytest.raises(BcrlError, match=meant or "lists all keys") as error:
        describe.describe(typed)
    assert typed in str(error.value)
