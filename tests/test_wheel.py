"""The wheel works outside of the repository, in an empty folder."""

import json
import os
import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

from bcrl.config.hydra_compose import CONF

ROOT = Path(__file__).parent.parent
FAST = ("scale=smoke", "algorithm/regressor=tabular", "progress=none")
pytestmark = pytest.mark.slow
pytest.importorskip("hatchling")  # of the extra `dev`


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The file that `python -m build` makes, with the installed build backend."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir"]
    subprocess.run([*command, str(folder), str(ROOT)], check=True)
    (made,) = folder.iterdir()
    return made


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    """The programs of a fresh environment with the wheel, and our dependencies."""
    folder = tmp_path_factory.mktemp("fresh") / "env"
    venv.create(folder, with_pip=False)
    programs = folder / "bin"
    pip = [sys.executable, "-m", "pip", "--python", str(programs / "python")]
    install = ["install", "--quiet", "--no-deps", "--no-index", "--no-compile"]
    subprocess.run([*pip, *install, str(wheel)], check=True)
    # Only now: pip must not take our own installation for the wanted one.
    (place,) = folder.glob("lib/python*/site-packages")
    ours = [path for path in sys.path if Path(path).name.endswith("-packages")]
    (place / "dependencies.pth").write_text("\n".join(ours) + "\n")
    # It lies in the checkout of another project, whose revision isn't the package's.
    who = ("-c", "user.name=x", "-c", "user.email=x@example.org")
    commit = [*who, "commit", "-q", "--allow-empty", "-m", "x"]
    for command in [["init", "-q"], commit] * bool(shutil.which("git")):
        subprocess.run(["git", "-C", folder.parent, *command], check=True)
    return programs


@pytest.fixture
def outside(installed, tmp_path):
    """Runs a program of the fresh environment in an empty folder: its two outputs."""

    def run(program: str, *words: str, code: int = 0) -> tuple[str, str]:
        clean = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
        clean |= {"XDG_CONFIG_HOME": str(tmp_path.parent)}
        command, kept = [installed / program, *words], {"capture_output": True}
        done = subprocess.run(command, cwd=tmp_path, env=clean, text=True, **kept)
        assert done.returncode == code, done.stdout + done.stderr
        return done.stdout, done.stderr

    return run


def test_all_that_is_no_cache_is_in_the_wheel(wheel):
    with zipfile.ZipFile(wheel) as opened:
        packed = opened.namelist()
    code = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "bcrl").rglob("*")
        if path.is_file() and path.suffix not in (".pyc", ".nbi", ".nbc")
    }
    configs = {f"bcrl/conf/{p.relative_to(CONF)}" for p in CONF.rglob("*.yaml")}
    assert code | configs == {name for name in packed if name.startswith("bcrl/")}
    tops = {name.split("/")[0] for name in packed}
    assert tops == {"bcrl", "boosted_curriculum_rl-0.1.0.dist-info"}


def test_it_runs_reports_and_verifies_in_an_empty_folder(outside, tmp_path):
    where, _ = outside("python", "-c", "import bcrl; print(bcrl.__file__)")
    assert str(ROOT) not in where and "site-packages" in where
    outside("bcrl", "env=maze", "curriculum=on", "boosting=on", *FAST)
    (about,) = tmp_path.glob("runs/smoke/maze/BC-FQI*/seed_0000.json")
    facts = json.loads(about.read_text())
    assert facts["git"] == {"revision": None, "dirty": False}
    assert facts["versions"]["bcrl"] == "0.1.0"
    text, _ = outside("bcrl-verify")
    assert "1 variants, 2 seeds complete; nothing wrong" in text
    outside("bcrl-report", "--scale", "smoke")
    assert list((tmp_path / "runs" / "figures").iterdir())
    for option in ("--help", "--status"):
        assert "maze" in outside("bcrl", option)[0]


def test_the_oracle_prints_its_table_also_by_its_old_name(outside):
    for name in ("bcrl.oracle", "bcrl.evaluation.oracle"):
        _, text = outside("python", "-m", name, "maze", "--height", "0.95")
        assert text.startswith("V*(s0) = -47.5575")
