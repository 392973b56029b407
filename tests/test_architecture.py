"""The layers and names of the package, and the weight of its imports."""

import importlib
import json
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import bcrl
from bcrl.common.moved import MOVED

PACKAGE = Path(bcrl.__file__).parent
#: Names that each module of one kind defines: environments, algorithms, oracles,
#: commands; `run` trains in both interfaces, `bcrl.api` and the runner.
PROTOCOLS = {"ENV", "FAMILY", "LOCKSTEP", "stages", "reference", "table", "main", "run"}


def test_no_modules_import_each_other_in_a_circle():
    """Imports within functions and for type checkers count, too."""
    graph = pytest.importorskip("grimp").build_graph("bcrl", cache_dir=None)
    for name in graph.modules:
        others = graph.find_modules_directly_imported_by(name) - {name}
        assert not others & graph.find_downstream_modules(name), name


def test_no_public_name_has_two_meanings():
    names = Counter()
    for path in PACKAGE.rglob("*.py"):
        pattern = r"^(?:def |class |(?=\w+(?:: .+)? = ))([a-zA-Z]\w*)"
        names.update(set(re.findall(pattern, path.read_text(), re.M)) - PROTOCOLS)
    assert [name for name, count in names.items() if count > 1] == []


@pytest.mark.parametrize("old", [*MOVED, "bcrl.learners.fqi"])
def test_an_old_name_of_a_module_gives_the_same_object(old):
    new = MOVED.get(old, "bcrl.learning.fqi")
    assert importlib.import_module(old) is importlib.import_module(new)


#: A module, and packages that its import must not load.
HEAVY = {"torch", "hydra", "numba"}
LIGHT = {
    "bcrl": HEAVY | {"numpy", "pandas", "scipy", "sklearn", "gymnasium"},
    "bcrl.results.verify": HEAVY,
    "bcrl.report.cli": HEAVY,
    "bcrl.run.runner": {"torch", "sklearn", "gymnasium", "matplotlib"},
}


@pytest.mark.parametrize("module", LIGHT)
def test_what_needs_no_learners_loads_none(module):
    text = f"import json, sys, {module}; print(json.dumps(list(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not LIGHT[module] & set(json.loads(done.stdout))
