"""The commands in the docs would run, and links lead somewhere."""

import re
import shlex
from pathlib import Path

import pytest

from bcrl.config import flags, jobs
from bcrl.run import status as overview

ROOT = Path(__file__).parents[1]
#: tests/test_other_packages.py runs this section's commands.
OTHER_PACKAGES = r"\n## Environments of other packages\n.*?(?=\n## )"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def commands(page: Path) -> list[str]:
    """The `bcrl` lines of a page's shell blocks, continued ones whole."""
    text = re.sub(OTHER_PACKAGES, "", page.read_text(encoding="utf-8"), flags=re.S)
    blocks = re.findall(r"```sh\n(.*?)```", text, re.S)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line for line in lines if re.match(r"bcrl [^…<$]*$", line)]


COMMANDS = [(page.name, line) for page in PAGES for line in commands(page)]


@pytest.mark.parametrize(("page", "line"), COMMANDS)
def test_every_command_would_run(page, line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = shlex.split(line, comments=True)[1:]
    asked = flags.flag_parser().parse_intermixed_args(words)
    if not asked.status:
        assert "nothing was run" in overview.dry_run(jobs.plans(asked))


def test_links_lead_somewhere():
    for page in PAGES:
        text = page.read_text()
        for target in re.findall(r"\]\((?!https?:)([^)#\s]+)", text):
            assert (page.parent / target).exists(), (page.name, target)
        for target, name in re.findall(r"\]\(([^)#\s]*)#([^)\s]+)\)", text):
            other = (page.parent / target) if target else page
            titles = re.findall(r"^#+ (.+)$", other.read_text(), re.M)
            slugs = {
                re.sub(r"[^\w\- ]", "", t.lower()).replace(" ", "-") for t in titles
            }
            assert name in slugs, (page.name, target, name)
