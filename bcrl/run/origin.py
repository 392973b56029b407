"""Where results come from: command, versions, revision, machine."""

import os
import platform
import re
import shlex
import subprocess
import sys
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bcrl import __version__

LIBRARIES = ("hydra-core", "numpy", "numba", "scikit-learn", "torch", "gymnasium")


def run_origin() -> dict[str, Any]:
    """The command, versions, git revision and machine."""
    program, *words = sys.argv
    versions = {"bcrl": __version__, "python": platform.python_version()}
    versions |= {name: version(name) for name in LIBRARIES}
    cpus = Path("/proc/cpuinfo")  # of Linux
    text = cpus.read_text("utf-8", "replace") if os.access(cpus, os.R_OK) else ""
    cpu = re.findall(r"model name\s*: (.*)", text) or [platform.processor()]
    # An installed package may lie in the checkout of another project.
    ours = _git("ls-files", "--error-unmatch", "__init__.py")
    dirty, system = bool(ours and _git("status", "--porcelain")), platform.platform()
    return {
        "command": shlex.join([Path(program).name, *words]),
        "versions": versions,
        "git": {"revision": ours and _git("rev-parse", "HEAD"), "dirty": dirty},
        "machine": {"system": system, "processor": cpu[0], "cores": os.cpu_count()},
    }


def _git(*arguments: str) -> str | None:
    """Git's output in this package's folder; None if the command fails."""
    folder = str(Path(__file__).resolve().parents[1])
    # If the timeout kills a command without locks, it leaves none in the repository.
    command = ["git", "--no-optional-locks", "-C", folder, *arguments]
    with suppress(OSError, subprocess.SubprocessError):
        done = subprocess.run(command, capture_output=True, timeout=10, check=True)
        return done.stdout.decode(errors="replace").strip()
    return None
