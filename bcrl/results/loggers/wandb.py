"""Weights & Biases: offline runs on this disk, which `wandb sync` uploads."""

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bcrl.results.layout import COMPLETE
from bcrl.results.loggers.base import Logger, Row, Run, Writer, check_installed, finite


@dataclass(frozen=True)
class WeightsAndBiases(Logger):
    """Offline runs in `<runs_dir>/.wandb`, one per seed."""

    project: str

    def __post_init__(self) -> None:
        check_installed("wandb", "wandb")

    def open(self, run: Run) -> Writer:
        return _OfflineRun(self.project, run)


class _OfflineRun(Writer):
    """Replaces what an interrupted process wrote, since all rows come again."""

    def __init__(self, project: str, run: Run) -> None:
        os.environ.setdefault("WANDB_ERROR_REPORTING", "false")  # it needs a network
        import wandb

        folder = run.runs_dir / ".wandb"  # by this name wandb takes it
        folder.mkdir(parents=True, exist_ok=True)
        for old in folder.glob(f"offline-run-*-{run.id}"):
            shutil.rmtree(old)
        quiet = wandb.Settings(
            console="off",
            silent=True,
            disable_git=True,
            x_disable_stats=True,
            x_save_requirements=False,
        )
        self._run = wandb.init(
            mode="offline",
            dir=run.runs_dir,
            id=run.id,
            project=project,
            name=run.name,
            group=run.name.rpartition("/")[0],
            tags=[str(tag)[:64] for key, tag in run.tags.items() if key != "seed"],
            config=run.settings,
            reinit="create_new",  # seeds that train together have a run each
            settings=quiet,
        )
        self._index, self._exit_code = run.index, 1
        self._run.define_metric("*", step_metric=run.index)

    def write(self, count: int, row: Row) -> None:
        self._run.log({self._index: count, **finite(row)})

    def finish(self, facts: Mapping[str, Any]) -> None:
        self._run.summary.update(dict(facts))
        self._exit_code = int(facts["status"] != COMPLETE)

    def close(self) -> None:
        self._run.finish(self._exit_code)
