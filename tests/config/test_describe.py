"""Every key has a description with its default, unit and allowed values."""

import pytest
import yaml
from omegaconf import OmegaConf

from bcrl.common.identity import flat
from bcrl.config import describe
from bcrl.config.hydra_compose import CONF, catalog, composed
from bcrl.errors import BcrlError

ENTRIES = describe.entries()
#: Keys with a free text as value.
FREE_TEXT = "name partition account qos constraint exclude gres comment submitit_folder"


def check_keys(*compositions: tuple[str, ...]) -> None:
    """Check that every key of these is described."""
    known = {entry.key for entry in ENTRIES if entry.parts[0]}
    for overrides in compositions:
        found = flat(OmegaConf.to_container(composed(overrides)))
        assert {key for key in found if not key.startswith("hydra.")} <= known


@pytest.mark.parametrize("env", catalog()["env"])
def test_every_key_of_every_composition_is_described(env):
    named = ("env.id=CartPole-v1",) if env == "gymnasium" else ()
    check_keys(*((f"env={env}", f"algorithm={a}", *named) for a in ("fqi", "dqn")))


def test_every_key_of_the_other_groups_is_described():
    for group in ("algorithm/regressor", "boosting", "transfer"):
        check_keys(*(("env=maze", f"{group}={each}") for each in catalog()[group]))
    slurm = yaml.safe_load((CONF / "hydra" / "launcher" / "slurm.yaml").read_text())
    launcher = {f"hydra.launcher.{key}" for key in slurm if key != "_target_"}
    assert launcher <= {entry.key for entry in ENTRIES}


def test_comments_have_all_their_parts():
    for entry in ENTRIES:
        text, unit, allowed = entry.parts
        assert text[0].isupper() and text.endswith("."), entry
        assert "Unit" not in text + unit and "Allowed" not in text + unit, entry
        assert allowed or entry.key.rpartition(".")[2] in FREE_TEXT.split(), entry


def test_a_description_has_default_unit_and_allowed_values():
    lines = [line.strip() for line in describe.describe("env.tasks.mass").splitlines()]
    said = ["Default: [0.8, 1.0, 1.2].", "Unit: kg.", "Allowed: > 0."]
    assert lines[0] == "env.tasks.mass" and lines[-3:] == said


def test_defaults_differ_between_options_and_environments():
    (gamma,) = (e for e in ENTRIES if e.key == "env.gamma")
    assert gamma.defaults["car_on_hill"] == 0.95 and gamma.defaults["maze"] == 0.99
    (iterations,) = (e for e in ENTRIES if e.key == "algorithm.iterations")
    assert iterations.defaults["fqi"] == 20
    assert iterations.defaults["env=car_on_hill"] == [20, 20, 20]


def test_a_word_is_a_key_a_group_a_section_or_a_typo(bcrl):
    done = bcrl("--describe", "transfer.nu=0.9")
    assert done.stdout == describe.describe("transfer.nu") + "\n", done.stderr
    assert "Default: 0.998." in done.stdout
    two_meanings = describe.describe("env.preset")
    assert "env=maze" in two_meanings and "env=linear_system" in two_meanings
    assert "variant=SBC: " in describe.describe("variant")
    assert "boosting=released: " in describe.describe("boosting")
    assert "seeds.count: " in describe.describe("seeds")
    assert len(describe.describe("").splitlines()) == len({e.key for e in ENTRIES})
    for typed, meant in (("env.gama", r"env\.gamma"), ("xyzzy", "lists all keys")):
        with pytest.raises(BcrlError, match=f"{typed}.*{meant}"):
            describe.describe(typed)
