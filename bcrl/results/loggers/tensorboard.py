"""TensorBoard: event files on this disk."""

from dataclasses import dataclass
from pathlib import Path

from bcrl.results.layout import LOGS
from bcrl.results.loggers.base import Logger, Row, Run, Writer, check_installed, finite


@dataclass(frozen=True)
class TensorBoard(Logger):
    """Event files in `<runs_dir>/.tensorboard`, one folder per seed."""

    def __post_init__(self) -> None:
        check_installed("tensorboard", "tensorboard")

    def open(self, run: Run) -> Writer:
        return _Events(run.runs_dir / LOGS / run.name)


class _Events(Writer):
    def __init__(self, folder: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter  # slow to import

        self._events = SummaryWriter(folder, purge_step=0)  # a resumed run logs anew

    def write(self, count: int, row: Row) -> None:
        for name, value in finite(row).items():
            self._events.add_scalar(name, value, count)

    def close(self) -> None:
        self._events.close()
