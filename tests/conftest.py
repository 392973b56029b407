"""What several tests share."""

import os
import subprocess
import sys
from argparse import Namespace
from pathlib import Path
from typing import Any

import pytest

from bcrl.common import plugins
from bcrl.config import hydra_compose, jobs
from bcrl.config.plan import Plan


@pytest.fixture(autouse=True, scope="session")
def _untraced() -> None:
    """Coverage skips the million calls of Hydra, whose time it would double."""
    traced = hydra_compose.compose

    def compose(*given: Any, **named: Any) -> Any:
        before = sys.gettrace()
        sys.settrace(None)
        try:
            return traced(*given, **named)
        finally:
            sys.settrace(before)

    hydra_compose.compose = compose


@pytest.fixture(autouse=True)
def _trusts_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which code of the user's may be named is forgotten after each test."""
    monkeypatch.setenv(plugins.VARIABLE, "")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests on Slurm come first: others run while they wait."""
    items.sort(key=lambda item: item.get_closest_marker("slurm") is None)


def arguments(*overrides: str, multirun=False, config_dir=None) -> Namespace:
    """What `bcrl *overrides` parses to."""
    words = {"overrides": list(overrides), "multirun": multirun}
    unset = {"config_name": None, "cfg": None, "unnamed": False}
    return Namespace(**words, **unset, config_dir=config_dir)


def plans(*overrides: str, **options) -> list[Plan]:
    """The plans that `bcrl *overrides` would run; options as in `arguments`."""
    return jobs.plans(arguments(*overrides, **options))


def plan(*overrides: str) -> Plan:
    """The one plan of `bcrl *overrides`."""
    (only,) = plans(*overrides)
    return only


@pytest.fixture
def bcrl(tmp_path: Path):
    """Runs the `bcrl` command in an empty folder."""

    def run(*arguments: str) -> subprocess.CompletedProcess:
        program = "import sys; sys.argv[0] = 'bcrl'; from bcrl.cli import main; main()"
        own = {"XDG_CONFIG_HOME": tmp_path / "-"}
        command, kept = [sys.executable, "-c", program, *arguments], os.environ | own
        pipes = {"capture_output": True, "text": True}
        return subprocess.run(command, cwd=tmp_path, env=kept, **pipes)

    return run
