"""The layers and names of the package, and the weight of its imports."""

import ast
import importlib
import json
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest

import bcrl
from bcrl.common.moved import MOVED

PACKAGE = Path(bcrl.__file__).parent
ROOT = PACKAGE.parent
#: Names that each module of one kind defines: environments, algorithms, oracles,
#: commands; `run` trains in both interfaces, `bcrl.api` and the runner.
PROTOCOLS = {"ENV", "PRESETS", "FAMILY", "LOCKSTEP", "Settings", "stages"}
PROTOCOLS |= {"reference", "table", "main", "parser", "run"}


def test_the_contracts_of_import_linter_hold():
    pytest.importorskip("importlinter")
    program = "from importlinter.cli import lint_imports_command as c; c()"
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout


def test_no_modules_import_each_other_in_a_circle():
    """Imports within functions and for type checkers count, too."""
    grimp = pytest.importorskip("grimp")
    graph = grimp.build_graph("bcrl", cache_dir=None)
    circles = {
        name: sorted(others)
        for name in graph.modules
        if (
            others := {
                other
                for other in graph.find_modules_directly_imported_by(name) - {name}
                if name in graph.find_upstream_modules(other)
            }
        )
    }
    assert circles == {}


def public_names(path: Path) -> set[str]:
    """The classes, functions and constants without underscore of a file."""
    found = set()
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        for target in getattr(node, "targets", [getattr(node, "target", None)]):
            if isinstance(target, ast.Name):
                found.add(target.id)
    return {name for name in found if not name.startswith("_")}


def test_no_public_name_has_two_meanings():
    places = defaultdict(list)
    for path in sorted(PACKAGE.rglob("*.py")):
        for name in public_names(path) - PROTOCOLS:
            places[name].append(str(path.relative_to(PACKAGE)))
    assert {name: found for name, found in places.items() if found[1:]} == {}


def test_the_top_of_the_package_has_few_modules():
    names = {path.stem for path in PACKAGE.glob("*.py")}
    assert len(names) <= 6, names


# --- old names ---


@pytest.mark.parametrize("old", MOVED)
def test_an_old_name_of_a_module_gives_the_same_object(old):
    assert importlib.import_module(old) is importlib.import_module(MOVED[old])


def test_modules_below_a_moved_package_move_with_it():
    old = importlib.import_module("bcrl.learners.fqi")
    assert old is importlib.import_module("bcrl.learning.fqi")


# --- the weight of imports ---

HEAVY = ("torch", "hydra", "numba", "numpy", "pandas", "scipy", "sklearn", "gymnasium")


def imported(program: str) -> tuple[float, set[str]]:
    """CPU seconds of a program's statements, and the packages that it has loaded."""
    text = (
        "import json, sys, time; began = time.process_time()\n"
        f"{program}\n"
        "spent = time.process_time() - began\n"
        "print(json.dumps([spent, sorted({n.partition('.')[0] for n in sys.modules})]))"
    )
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    spent, names = json.loads(done.stdout.splitlines()[-1])
    return spent, set(names)


def test_importing_the_package_is_light():
    spent, names = imported("import bcrl")
    assert spent <= 0.3 and not names & set(HEAVY)


@pytest.mark.parametrize("module", ["results.verify", "results.read", "report.cli"])
def test_reading_and_drawing_results_loads_no_learners(module):
    _, names = imported(f"import bcrl.{module}")
    assert not names & {"torch", "hydra", "numba"}
