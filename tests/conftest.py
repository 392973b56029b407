"""What several tests share."""

import os
import subprocess
import sys
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest

from bcrl.common import plugins
from bcrl.config import hydra_compose, jobs
from bcrl.config.plan import Plan

LONG = ("slow", "slurm", "browser")


@contextmanager
def _untraced() -> Iterator[None]:
    """Coverage is blind meanwhile: it would double the time of what has many calls."""
    before = sys.gettrace()
    sys.settrace(None)
    try:
        yield
    finally:
        sys.settrace(before)


hydra_compose.compose = _untraced()(hydra_compose.compose)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """The tests that take long stay out of the coverage."""
    with _untraced() if any(map(item.get_closest_marker, LONG)) else nullcontext():
        return (yield)


@pytest.fixture(autouse=True)
def _trusts_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which code of the user's may be named is forgotten after each test."""
    monkeypatch.setenv(plugins.VARIABLE, "")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests on Slurm come first, as others run while they wait; then the slow ones."""
    for mark in ("slow", "slurm"):
        items.sort(key=lambda item: item.get_closest_marker(mark) is None)


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
