"""Tables beside the tests, and configs of a user's own."""

import textwrap
from pathlib import Path


def rows(name: str) -> list[list[str]]:
    """The cells of a table; `#` begins a comment."""
    text = Path(__file__).with_name(name).read_text("utf-8")
    lines = [line for line in text.splitlines() if line and line[0] != "#"]
    return [[cell.strip() for cell in line.split("|")] for line in lines]


def own(folder: Path, text: str, place: str = "experiment/mine") -> str:
    """Writes a user's config and returns its folder."""
    path = folder / "own" / f"{place}.yaml"
    path.parent.mkdir(parents=True, exist_ok=True)
    head = "# @package _global_\n" if place.startswith(("experiment", "local")) else ""
    path.write_text(head + textwrap.dedent(text) + "\n")
    return str(folder / "own")
