"""The commands in the docs would run, what the docs name exists, and citations."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest
import yaml

import bcrl
from bcrl.config import flags, jobs
from bcrl.run import status

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / x for x in ("README.md", "CONTRIBUTING.md", "bench/README.md")]
PAGES += sorted(DOCS.rglob("*.md"))
TEXT = {page: page.read_text("utf-8") for page in PAGES}
SLOW = r"experiment=|env=gymnasium|env=mountain_car"
#: Made when the site is built.
GENERATED = DOCS / "reference" / "config.md"


def commands(page: Path) -> list[str]:
    """The `bcrl` lines of a page's shell blocks, whole and without comments.

    tests/test_own.py runs those with a folder of configs.
    """
    blocks = re.findall(r"```sh\n(.*?)```", TEXT[page], re.S)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    found = [line for line in lines if re.match(r"bcrl (?!--config-dir)[^…<$]*$", line)]
    return [shlex.join(shlex.split(line, comments=True)) for line in found]


#: tests/envs/test_other_packages.py runs the commands of its page.
PLACES = [page for page in PAGES if page.name != "other_packages.md"]
COMMANDS = dict.fromkeys(line for page in PLACES for line in commands(page))
slow = {line: [pytest.mark.slow] * bool(re.search(SLOW, line)) for line in COMMANDS}


@pytest.mark.parametrize("line", [pytest.param(x, marks=slow[x]) for x in COMMANDS])
def test_every_command_would_run(line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", shlex.split(line))
    arguments = flags.arguments()
    if not arguments.status:
        assert "nothing was run" in status.dry_run(jobs.plans(arguments))


def anchors(page: Path) -> set[str]:
    titles = re.findall(r"^#+ (.+)$", TEXT[page], re.M)
    return {re.sub(r"[^\w\- ]", "", t.lower()).replace(" ", "-") for t in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_named_files_exist(page):
    """Files such as `bcrl/learning/stage.py`, `tests/run/` or `examples/own_env.py`."""
    text = re.sub(r"```.*?```", "", TEXT[page], flags=re.S)
    for link in re.findall(r"\]\((?!https?:)([^)\s]+)\)", text):
        target, _, name = link.partition("#")
        other = (page.parent / target).resolve() if target else page
        assert other.exists() or other == GENERATED, target
        assert not name or name in anchors(other), (target, name)
    folders = "bcrl|tests|conf|examples|bench|docs"
    for name in re.findall(rf"`((?:{folders})/[\w./-]*(?:/|\.\w+))`", TEXT[page]):
        assert (ROOT / name).exists(), name


def test_pages_that_code_and_configs_name_exist():
    for pattern in ("bcrl/**/*.py", "conf/**/*.yaml", "examples/*.py"):
        for path in ROOT.glob(pattern):
            for name in re.findall(r"docs/[\w/]+\.md", path.read_text("utf-8")):
                assert (ROOT / name).exists(), (path, name)


def test_every_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text("utf-8").partition("\nnav:")[2]
    listed = set(re.findall(r": ([\w/.-]+\.md)$", navigation, re.M))
    pages = {*DOCS.rglob("*.md"), GENERATED}
    assert listed == {page.relative_to(DOCS).as_posix() for page in pages}


def test_the_glossary_explains_the_symbols_and_short_forms():
    terms = "ϱ s0 T1 F ν LSPI PPR RPL LQ IQM @released slot lane base potential prior"
    terms += " lockstep seed stage task residual boosting curriculum shaping transfer"
    first = re.findall(r"^\| (.*?) \|", TEXT[DOCS / "reference" / "glossary.md"], re.M)
    for term in terms.split():
        assert any(re.search(rf"(?<!\w){re.escape(term)}\b", x) for x in first), term


def test_there_is_one_version_and_the_papers_authors_are_named():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert bcrl.__version__ == project["version"] == str(cited["version"])
    for author in cited["preferred-citation"]["authors"]:
        assert author["family-names"] in TEXT[ROOT / "README.md"]
    found = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert found == ["Unreleased", bcrl.__version__]


def test_the_two_files_are_included_in_their_page():
    marked = re.findall(r'^--8<-- "(.+)"$', TEXT[DOCS / "tutorial/two_files.md"], re.M)
    assert marked == [f"examples/minimal_{name}.py" for name in ("bc_fqi", "sbc_dqn")]
    assert all((ROOT / name).exists() for name in marked)
