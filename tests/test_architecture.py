"""Imports go one way, and what the docs say of the order is so."""

import ast
import re
from pathlib import Path

import bcrl

PACKAGE = Path(bcrl.__file__).parent
DOCS = PACKAGE.parent / "docs" / "architecture.md"


def layers() -> dict[str, int]:
    """Top-level module → its place in the chain of docs/architecture.md."""
    text = re.search(r"a test checks it: `(.+?)`", DOCS.read_text(), re.S)[1]
    return {
        name.strip(): place
        for place, names in enumerate(text.split("→"))
        for name in names.split(",")
    }


def imported(path: Path) -> set[str]:
    """Top-level modules of bcrl that a file imports, type hints' imports too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == "bcrl":
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module.startswith("bcrl."):
            found.add(node.module.split(".")[1])
    return found - {"__version__"}


def test_imports_go_one_way_as_the_docs_say():
    order = layers()
    for path in PACKAGE.rglob("*.py"):
        own = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if own == "__init__":
            continue
        for other in imported(path) - {own}:
            if own == "report":
                shows = path.name == "animation.py"
                allowed = ("drawing", "envs", "tasks") if shows else ()
                shared = ("divergence", "errors", "identity", "files", "terminal")
                assert other in (*shared, *allowed), path
            else:
                assert order[other] < order[own], (path, other)
