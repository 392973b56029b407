"""CITATION.cff has what its format's version 1.2.0 requires; there is one version."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

import bcrl

ROOT = Path(__file__).parent.parent
CFF = yaml.safe_load((ROOT / "CITATION.cff").read_text())
#: Of the schema's keys those that are used.
TOP = {
    *("cff-version", "message", "type", "title", "version", "license"),
    *("authors", "abstract", "keywords", "preferred-citation"),
}


def test_the_required_keys_are_there_and_no_unknown_ones():
    assert CFF["cff-version"] == "1.2.0" and CFF["type"] in ("software", "dataset")
    assert CFF.keys() >= {"cff-version", "message", "title", "authors"}
    assert CFF.keys() <= TOP
    assert len(set(CFF["keywords"])) == len(CFF["keywords"])


@pytest.mark.parametrize("cited", [CFF, CFF["preferred-citation"]])
def test_every_author_is_a_person_or_has_a_name(cited):
    assert cited["title"] and cited["type"] and cited["authors"]
    for author in cited["authors"]:
        assert author.keys() in ({"name"}, {"given-names", "family-names"})
        assert all(isinstance(name, str) and name for name in author.values())


def test_the_paper_is_what_is_cited():
    paper = CFF["preferred-citation"]
    assert (paper["type"], paper["year"]) == ("conference-paper", 2022)
    names = [author["family-names"] for author in paper["authors"]]
    readme = (ROOT / "README.md").read_text()
    assert all(name in readme for name in names) and paper["conference"]["name"]


def test_there_is_one_version():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert bcrl.__version__ == project["version"] == str(CFF["version"])
    changes = (ROOT / "CHANGELOG.md").read_text()
    assert re.findall(r"^## \[(.+?)\]", changes, re.M) == [
        "Unreleased",
        bcrl.__version__,
    ]
