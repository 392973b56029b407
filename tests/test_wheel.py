"""The wheel works outside of the repository, in an empty folder."""

import json
import os
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

from bcrl.config.hydra_compose import CONF

ROOT = Path(__file__).parent.parent
FAST = ("scale=smoke", "algorithm/regressor=tabular", "progress=none")
pytestmark = pytest.mark.slow
pytest.importorskip("hatchling")  # of the extra `dev`


def build(source: Path, folder: Path, *what: str) -> list[Path]:
    """The files that `python -m build` makes, with the installed build backend."""
    command = [sys.executable, "-m", "build", "--no-isolation", *what]
    done = subprocess.run(
        [*command, "--outdir", str(folder), str(source)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return sorted(folder.iterdir())


def contents(wheel: Path) -> dict[str, int]:
    """A wheel's files and their CRC-32, but for the list of them."""
    with zipfile.ZipFile(wheel) as packed:
        return {
            entry.filename: entry.CRC
            for entry in packed.infolist()
            if not entry.filename.endswith("/RECORD")
        }


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    return build(ROOT, tmp_path_factory.mktemp("wheel"), "--wheel")[0]


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
    return programs


@pytest.fixture
def outside(installed, tmp_path):
    """Runs a program of the fresh environment in an empty folder."""

    def run(*command: str, **variables: str) -> subprocess.CompletedProcess:
        clean = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
        clean |= {"XDG_CONFIG_HOME": str(tmp_path.parent)}
        program = str(installed / command[0])
        return subprocess.run(
            [program, *command[1:]],
            cwd=tmp_path,
            env=clean | variables,
            capture_output=True,
            text=True,
        )

    return run


def test_all_that_is_no_cache_is_in_the_wheel(wheel):
    packed = contents(wheel)
    code = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "bcrl").rglob("*")
        if path.is_file() and path.suffix not in (".pyc", ".nbi", ".nbc")
    }
    configs = {f"bcrl/conf/{p.relative_to(CONF)}" for p in CONF.rglob("*.yaml")}
    assert code | configs == {name for name in packed if name.startswith("bcrl/")}
    tops = {name.split("/")[0] for name in packed}
    assert tops == {"bcrl", "boosted_curriculum_rl-0.1.0.dist-info"}


def test_the_sources_archive_makes_the_same_wheel(wheel, tmp_path):
    (archive,) = build(ROOT, tmp_path / "sdist", "--sdist")
    with tarfile.open(archive) as packed:
        packed.extractall(tmp_path / "unpacked", filter="data")
    (source,) = (tmp_path / "unpacked").iterdir()
    for needed in ("README.md", "docs/architecture.md", "tests/conftest.py"):
        assert (source / needed).exists()
    (again,) = build(source, tmp_path / "wheel", "--wheel")
    assert contents(again) == contents(wheel)


def test_it_runs_reports_and_verifies_in_an_empty_folder(outside, tmp_path):
    where = outside("python", "-c", "import bcrl; print(bcrl.__file__)").stdout
    assert str(ROOT) not in where and "site-packages" in where
    done = outside("bcrl", "env=maze", "curriculum=on", "boosting=on", *FAST)
    assert done.returncode == 0, done.stderr
    (about,) = tmp_path.glob("runs/smoke/maze/BC-FQI*/seed_0000.json")
    facts = json.loads(about.read_text())
    assert facts["git"] == {"revision": None, "dirty": False}
    assert facts["versions"]["bcrl"] == "0.1.0"
    done = outside("bcrl-verify")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 variant, 2 seeds complete; nothing wrong" in done.stdout
    done = outside("bcrl-report", "--scale", "smoke")
    assert done.returncode == 0, done.stdout + done.stderr
    assert list((tmp_path / "runs" / "figures").iterdir())
    for asked in ("--help", "--status"):
        done = outside("bcrl", asked)
        assert done.returncode == 0 and "maze" in done.stdout, done.stderr


def test_the_oracle_prints_its_table_also_by_its_old_name(outside):
    for name in ("bcrl.oracle", "bcrl.evaluation.oracle"):
        done = outside("python", "-m", name, "maze", "--height", "0.95")
        assert done.returncode == 0, done.stderr
        assert done.stderr.startswith("V*(s0) = -47.5575")


def test_a_users_own_env_comes_from_a_folder_and_a_module(outside, tmp_path):
    (tmp_path / "my_mazes.py").write_text(
        "from bcrl.envs.maze import ENV as Maze\n\n\n"
        "class ENV(Maze):\n    name = 'my_maze'\n"
    )
    yaml = (
        (CONF / "env" / "maze.yaml").read_text().replace("name: maze", "name: my_mazes")
    )
    place = tmp_path / "mine" / "env" / "my_maze.yaml"
    place.parent.mkdir(parents=True)
    place.write_text(yaml)
    command = ("bcrl", "--config-dir=mine", "env=my_maze", "variant=BC", *FAST)
    command += ("env.metrics=[return]",)
    refused = outside(*command)
    assert refused.returncode == 2 and "env.name=my_mazes" in refused.stderr
    done = outside(*command, BCRL_TRUST="my_mazes", PYTHONPATH=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert len(list(tmp_path.glob("runs/smoke/my_maze/BC-FQI*/seed_*.csv"))) == 2


def test_a_package_inside_another_projects_checkout_is_not_of_its_revision(
    outside, installed
):
    git = shutil.which("git")
    if git is None:
        pytest.skip("no git")
    project = installed.parent.parent
    who = ("-c", "user.name=x", "-c", "user.email=x@example.org")
    for command in (["init", "-q"], [*who, "commit", "-q", "--allow-empty", "-m", "x"]):
        subprocess.run([git, "-C", str(project), *command], check=True)
    program = "from bcrl.run.origin import run_origin; print(run_origin()['git'])"
    done = outside("python", "-c", program)
    assert done.stdout == "{'revision': None, 'dirty': False}\n", done.stderr
