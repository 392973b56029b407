"""The commands in the docs would run, and what the docs name exists."""

import re
import shlex
from pathlib import Path

import pytest

from bcrl.config import flags, jobs
from bcrl.run import status

ROOT = Path(__file__).parents[1]
#: tests/envs/test_other_packages.py runs this page's commands.
OTHER_PACKAGES = "other_packages.md"
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "bench/README.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
#: Commands that compose many jobs, or try out simulators.
SLOW = r"experiment=|env=gymnasium|env=mountain_car"
#: Pages that are made when the site is built.
GENERATED = (ROOT / "docs" / "reference" / "config.md",)


def commands(page: Path) -> list[str]:
    """The `bcrl` lines of a page's shell blocks, whole and without comments.

    tests/test_own.py runs those with a folder of configs.
    """
    blocks = re.findall(r"```sh\n(.*?)```", page.read_text(encoding="utf-8"), re.S)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    found = [line for line in lines if re.match(r"bcrl (?!--config-dir)[^…<$]*$", line)]
    return [shlex.join(shlex.split(line, comments=True)) for line in found]


COMMANDS = dict.fromkeys(
    line for page in PAGES if page.name != OTHER_PACKAGES for line in commands(page)
)


@pytest.mark.parametrize(
    "line",
    [
        pytest.param(line, marks=pytest.mark.slow) if re.search(SLOW, line) else line
        for line in COMMANDS
    ],
)
def test_every_command_would_run(line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = shlex.split(line)[1:]
    arguments = flags.flag_parser().parse_intermixed_args(words)
    if not arguments.status:
        assert "nothing was run" in status.dry_run(jobs.plans(arguments))


def anchors(page: Path) -> set[str]:
    titles = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.M)
    return {re.sub(r"[^\w\- ]", "", t.lower()).replace(" ", "-") for t in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    for target, _, name in (
        link.partition("#") for link in re.findall(r"\]\((?!https?:)([^)\s]+)\)", text)
    ):
        other = (page.parent / target).resolve() if target else page
        assert other.exists() or other in GENERATED, target
        assert not name or name in anchors(other), (target, name)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_named_files_exist(page):
    """Such as `bcrl/learning/stage.py`, `tests/run/` or `examples/own_env.py`."""
    for name in re.findall(
        r"`((?:bcrl|tests|conf|examples|bench|docs)/[\w./-]*(?:/|\.\w+))`",
        page.read_text("utf-8"),
    ):
        assert (ROOT / name).exists(), name


def test_pages_that_code_and_configs_name_exist():
    for folder, ending in (("bcrl", "py"), ("conf", "yaml"), ("examples", "py")):
        for path in (ROOT / folder).rglob(f"*.{ending}"):
            for name in re.findall(r"docs/[\w/]+\.md", path.read_text("utf-8")):
                assert (ROOT / name).exists(), (path, name)


SHORT = {
    **{"FQI": "fitted Q-iteration", "DQN": "deep Q-network", "LQ": "linear-quadratic"},
    **{"LSPI": "least-squares policy iteration", "IQM": "interquartile mean"},
    **{
        "PPR": "policy reuse",
        "RPL": "residual polic",
        "ϱ": "residual",
        "γ": "discount",
    },
}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_short_forms_are_spelled_out_on_each_page(page):
    text = page.read_text("utf-8")
    words = " ".join(text.split()).lower()
    prose = re.sub(r"```.*?```|`[^`]*`", "", text, flags=re.S)
    for short, meaning in SHORT.items():
        if re.search(rf"(?<!\w){short}(?!\w)", prose):
            assert meaning.lower() in words, short


def test_every_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text("utf-8").partition("\nnav:")[2]
    listed = set(re.findall(r": ([\w/.-]+\.md)$", navigation, re.M))
    pages = {path.relative_to(ROOT / "docs") for path in (ROOT / "docs").rglob("*.md")}
    made = {path.relative_to(ROOT / "docs") for path in GENERATED}
    assert listed == {page.as_posix() for page in pages | made}


def test_the_glossary_explains_the_symbols_and_short_forms():
    glossary = (ROOT / "docs" / "reference" / "glossary.md").read_text("utf-8")
    terms = "ϱ s0 T1 F ν LSPI PPR RPL LQ IQM @released slot lane base potential prior"
    terms += " lockstep seed stage task residual boosting curriculum shaping transfer"
    first = re.findall(r"^\| (.*?) \|", glossary, re.M)
    for term in terms.split():
        assert any(re.search(rf"(?<!\w){re.escape(term)}\b", x) for x in first), term
