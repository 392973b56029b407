"""MLflow: runs in a local SQLite file, or on a server."""

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from filelock import FileLock

from bcrl.common.identity import as_text
from bcrl.errors import BcrlError
from bcrl.results.layout import COMPLETE
from bcrl.results.loggers.base import Logger, Row, Run, Writer, check_installed, finite

SECONDS = 5.0  # between two batches: twenty rows in one take a tenth of the time
_MOST_METRICS, _MOST_PARAMS = 1000, 100  # that MLflow takes at once


@dataclass(frozen=True)
class MLflow(Logger):
    """Runs of an experiment in `<runs_dir>/.mlflow/mlflow.db`, or at an address."""

    experiment: str
    tracking_uri: str | None

    def __post_init__(self) -> None:
        check_installed("mlflow", "mlflow", "sqlalchemy", "alembic")

    def open(self, run: Run) -> Writer:
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")  # it needs a network
        os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")
        from mlflow import MlflowClient  # slow to import
        from mlflow.exceptions import MlflowException

        folder = run.runs_dir.resolve() / ".mlflow"
        folder.mkdir(parents=True, exist_ok=True)
        address, artifacts = self.tracking_uri, None
        if address is None:
            if {"%", "?"} & {*str(folder)}:
                why = "a path with % or ? has no MLflow address; name another"
                raise BcrlError(f"runs_dir={run.runs_dir}: {why}")
            address = f"sqlite:///{folder / 'mlflow.db'}"
            artifacts = (folder / "artifacts").as_uri()
        with FileLock(folder / "lock"):  # only one process can make its tables
            client = MlflowClient(address)
            try:
                experiment = client.create_experiment(self.experiment, artifacts)
            except MlflowException:  # it exists
                found: Any = client.get_experiment_by_name(self.experiment)
                experiment = found.experiment_id
        return _StoredRun(client, experiment, run)


class _StoredRun(Writer):
    """Sends the rows that its run in the store lacks.

    Values in a store stay. So if it has others, of a training that was deleted, a new
    run begins there.
    """

    def __init__(self, client: Any, experiment: str, run: Run) -> None:
        self._client, self._experiment, self._run = client, experiment, run
        self._rows: list[tuple[str, int, float]] = []  # name, step and value of each
        self._stored: set[tuple[str, int, float]] = set()
        self._status, self._sent = "KILLED", time.monotonic()
        mine = f"tags.`bcrl.id` = '{run.id}'"
        if found := client.search_runs([experiment], mine, max_results=1):
            self._id = found[0].info.run_id  # the newest
            client.update_run(self._id, status="RUNNING")
            for name in found[0].data.metrics:
                history = client.get_metric_history(self._id, name)
                self._stored |= {(name, each.step, each.value) for each in history}
        else:
            self._begin()

    def _begin(self) -> None:
        from mlflow.entities import Param

        run, client = self._run, self._client
        tags = {key: str(tag) for key, tag in run.tags.items()} | {"bcrl.id": run.id}
        made = client.create_run(self._experiment, tags=tags, run_name=run.name)
        self._id, self._stored = made.info.run_id, set()
        params = [Param(key, as_text(value)) for key, value in run.settings.items()]
        for i in range(0, len(params), _MOST_PARAMS):
            client.log_batch(self._id, params=params[i : i + _MOST_PARAMS])

    def write(self, count: int, row: Row) -> None:
        self._rows += [(name, count, value) for name, value in finite(row).items()]
        if time.monotonic() - self._sent > SECONDS:
            self._send()

    def _send(self, ended: bool = False) -> None:
        """Send the rows that are missing; those of the last step may yet come."""
        from mlflow.entities import Metric

        last = max((step for _, step, _ in self._rows), default=0)
        others = self._stored - set(self._rows)
        if any(step < last or ended for _, step, _ in others):
            self._begin()
        missing = [each for each in self._rows if each not in self._stored]
        now = int(time.time() * 1000)
        metrics = [Metric(name, value, now, step) for name, step, value in missing]
        for i in range(0, len(metrics), _MOST_METRICS):
            self._client.log_batch(self._id, metrics[i : i + _MOST_METRICS])
        self._stored |= set(missing)
        self._sent = time.monotonic()

    def finish(self, facts: Mapping[str, Any]) -> None:
        from mlflow.entities import RunTag

        self._send(ended=True)
        tags = [RunTag(key, as_text(value)) for key, value in facts.items()]
        self._client.log_batch(self._id, tags=tags)
        self._status = "FINISHED" if facts["status"] == COMPLETE else "FAILED"

    def close(self) -> None:
        self._send()
        self._client.set_terminated(self._id, self._status)
