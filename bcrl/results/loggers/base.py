"""A logger: a dataclass that opens a writer for the run of each seed."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from bcrl.common.files import sha256
from bcrl.common.identity import flat, identity
from bcrl.errors import ConfigError

Row = Mapping[str, float]


@dataclass(frozen=True)
class Run:
    """One seed's run, as its logger gets it before the first row."""

    runs_dir: Path
    name: str  # "quick/maze/BC-FQI/seed_0007"
    index: str  # the column that counts: "iteration" or "step"
    tags: Mapping[str, Any]  # seed, scale, env, variant, tag
    config: Mapping[str, Any]  # resolved, whole

    @property
    def settings(self) -> dict[str, Any]:
        """What decides the numbers: the seed, and the config's keys with dots."""
        return {"seed": self.tags["seed"], **flat(identity(dict(self.config)))}

    @property
    def id(self) -> str:
        """16 hexadecimal digits, the same when the run resumes or is sent again."""
        place = str(self.runs_dir.resolve() / self.name)
        return sha256(json.dumps([place, self.settings]).encode())[:16]


class Writer:
    """Takes one seed's rows, all again if a run resumes; this one drops them."""

    def write(self, count: int, row: Row) -> None:
        """A row of the seed's CSV, by its count of iterations or steps."""

    def finish(self, facts: Mapping[str, Any]) -> None:
        """The seed is complete, or failed: `status`, costs and versions of its JSON."""

    def close(self) -> None:
        """Nothing more will come from this process."""


@dataclass(frozen=True)
class Logger:
    """Logs nothing. The fields of others are the YAML's keys besides `name`; made
    before work starts, they raise ConfigError if they can't do their work."""

    def open(self, run: Run) -> Writer:
        """A writer for a seed's run."""
        return Writer()


def check_installed(name: str, *modules: str) -> None:
    """Raise ConfigError unless the modules of the extra `name` are installed."""
    for module in modules:
        # A folder of that name is found, too, but has no origin.
        if getattr(find_spec(module), "origin", None) is None:
            why = f"needs {module}: pip install 'boosted-curriculum-rl[{name}]'"
            raise ConfigError("logger", name, why)


def finite(row: Row) -> dict[str, float]:
    """A row without missing and infinite values."""
    return {name: value for name, value in row.items() if np.isfinite(value)}
