"""Where results come from: command, versions, revision, machine."""

from __future__ import annotations

import os
import platform
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bcrl import __version__

LIBRARIES = ("hydra-core", "numpy", "numba", "scikit-learn", "torch", "gymnasium")


def run_origin() -> dict[str, Any]:
    """The command, versions, git revision and machine."""
    program, *words = sys.argv
    return {
        "command": shlex.join([Path(program).name, *words]),
        "versions": {
            "bcrl": __version__,
            "python": platform.python_version(),
            **{name: version(name) for name in LIBRARIES},
        },
        "git": _revision(),
        "machine": {
            "system": platform.platform(),
            "processor": _processor(),
            "cores": os.cpu_count(),
        },
    }


def _revision() -> dict[str, Any]:
    """The git revision of the checkout that this package belongs to, if any.

    An installed package may lie in the checkout of another project.
    """
    if _git("ls-files", "--error-unmatch", "__init__.py") is None:
        return {"revision": None, "dirty": False}
    dirty = _git("status", "--porcelain") not in ("", None)
    return {"revision": _git("rev-parse", "HEAD"), "dirty": dirty}


def _git(*arguments: str) -> str | None:
    """Git's output in this package's folder; None if the command fails."""
    command = ["git", "-C", str(Path(__file__).resolve().parents[1]), *arguments]
    options: Any = {"encoding": "utf-8", "errors": "replace", "timeout": 10}
    try:
        done = subprocess.run(command, capture_output=True, **options)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
    except OSError:
        return platform.processor()
    names = (line.split(":", 1)[1].strip() for line in lines if "model name" in line)
    return next(names, platform.processor())
