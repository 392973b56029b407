"""Live logging: what runs measure, sent elsewhere while they train."""

import importlib.util
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bcrl.common import plugins
from bcrl.common.checks import construct, one_of
from bcrl.errors import ConfigError
from bcrl.results.layout import LOGS, seed_name

Row = Mapping[str, float]
#: Takes the name of the column that counts, and each seed's new rows.
Log = Callable[[str, Sequence[Sequence[Row]]], None]


class Writer:
    """Takes one seed's rows, all again if a run resumes; this one drops them."""

    def write(self, count: int, row: Row) -> None:
        """A row of the seed's CSV, by its count of iterations or steps."""

    def close(self) -> None:
        """Nothing more will come from this process."""


@dataclass(frozen=True)
class Logger:
    """Logs nothing. The fields of others are the YAML's keys besides `name`; made
    before work starts, they raise ConfigError if they can't do their work."""

    def open(self, runs_dir: Path, run: str) -> Writer:
        """A writer for `run`, such as "quick/maze/BC-FQI/seed_0007"."""
        return Writer()


@dataclass(frozen=True)
class TensorBoard(Logger):
    """Event files in `<runs_dir>/.tensorboard`, one folder per seed."""

    def __post_init__(self) -> None:
        if importlib.util.find_spec("tensorboard") is None:
            why = "needs a package: pip install 'boosted-curriculum-rl[tensorboard]'"
            raise ConfigError("logger", "tensorboard", why)

    def open(self, runs_dir: Path, run: str) -> Writer:
        return _Events(runs_dir / LOGS / run)


class _Events(Writer):
    def __init__(self, folder: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter  # slow to import

        self._events = SummaryWriter(folder, purge_step=0)  # a resumed run logs anew

    def write(self, count: int, row: Row) -> None:
        for name, value in row.items():
            if np.isfinite(value):
                self._events.add_scalar(name, value, count)

    def close(self) -> None:
        self._events.close()


LOGGERS: dict[str, type] = {"none": Logger, "tensorboard": TensorBoard}


def logger(section: Any) -> Logger:
    """The logger of a config's section `logger`; ConfigError if there is none such.
    Besides LOGGERS a class of the user's own may be named, as BCRL_TRUST allows."""
    if not isinstance(section, dict) or not isinstance(section.get("name"), str):
        raise ConfigError("logger", section, "must be a section with a name")
    values = dict(section)
    name = values.pop("name")
    if "." not in name:
        one_of("logger.name", name, list(LOGGERS))
    cls = LOGGERS.get(name) or plugins.component("logger.name", name, name)
    return construct("logger", cls, values)


@contextmanager
def opened(
    config: Mapping[str, Any], directory: Path, seeds: Sequence[int]
) -> Iterator[Log]:
    """A function that takes new rows of the run in `directory`, a list per seed."""
    made, root = logger(config["logger"]), Path(config["runs_dir"])
    folder = directory.relative_to(root).as_posix()
    with ExitStack() as stack:
        opening = (made.open(root, f"{folder}/{seed_name(seed)}") for seed in seeds)
        writers = [stack.enter_context(closing(writer)) for writer in opening]

        def log(index: str, rows: Sequence[Sequence[Row]]) -> None:
            for writer, added in zip(writers, rows, strict=True):
                for row in added:
                    rest = {key: value for key, value in row.items() if key != index}
                    writer.write(int(row[index]), rest)

        yield log
