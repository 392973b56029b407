"""Live logging: what runs measure, sent elsewhere while they train or afterwards."""

import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from bcrl.common import plugins
from bcrl.common.checks import construct, one_of
from bcrl.common.files import DIGEST
from bcrl.common.identity import flat
from bcrl.common.terminal import say
from bcrl.errors import BcrlError, ConfigError
from bcrl.results import layout
from bcrl.results.loggers.base import Logger, Row, Run, Writer
from bcrl.results.loggers.mlflow import MLflow
from bcrl.results.loggers.tensorboard import TensorBoard
from bcrl.results.loggers.wandb import WeightsAndBiases
from bcrl.results.read import Finding, read_document

#: Takes the new rows of each seed.
Log = Callable[[Sequence[Sequence[Row]]], None]
LOGGERS: dict[str, type] = {"none": Logger, "tensorboard": TensorBoard}
LOGGERS |= {"mlflow": MLflow, "wandb": WeightsAndBiases}
#: Entries of a seed's JSON that a logger knows already, or that are about its files.
_OTHER = {"seed", "scale", "env", "variant", "tag", "config"}
_OTHER |= {"schema", "asked", "sha256", DIGEST}


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


def run_of(folder: Path, seed: int, index: str, config: Mapping[str, Any]) -> Run:
    """The run of a seed of the variant in `folder`."""
    tags = {k: v for k, v in layout.belongs_to(folder, seed).items() if v is not None}
    name = "/".join([*folder.parts[-3:], layout.seed_name(seed)])
    return Run(folder.parents[2], name, index, tags, config)


def write(writer: Writer, index: str, row: Row) -> None:
    """Hand a row of a CSV to a writer."""
    rest = {key: value for key, value in row.items() if key != index}
    writer.write(int(row[index]), rest)


def facts(document: Mapping[str, Any]) -> dict[str, Any]:
    """What a seed's JSON says about its end: the status, costs, versions, machine."""
    return flat({k: v for k, v in document.items() if k not in _OTHER})


@contextmanager
def opened(
    config: Mapping[str, Any], folder: Path, seeds: Sequence[int], index: str
) -> Iterator[Log]:
    """A function that takes new rows of the run in `folder`, a list per seed.

    An error of the logger ends the log of these seeds, not their training.
    """
    made, writers = logger(config["logger"]), list[Writer]()

    @contextmanager
    def guarded() -> Iterator[None]:
        try:
            yield
        except Exception as error:
            if not isinstance(error, BcrlError):
                say(traceback.format_exc())
            for writer in writers:
                with suppress(Exception):
                    writer.close()
            writers.clear()
            why = (
                "training continues without its log; send it later with --send-complete"
            )
            say(f"{folder}: the logger failed: {type(error).__name__}: {error}; {why}")

    def log(rows: Sequence[Sequence[Row]]) -> None:
        with guarded():
            for writer, added in zip(writers, rows, strict=False):
                for row in added:
                    write(writer, index, row)

    with guarded():
        for seed in seeds:
            writers.append(made.open(run_of(folder, seed, index, config)))
    try:
        yield log
    finally:
        with guarded():
            for seed, writer in zip(seeds, writers, strict=False):
                with suppress(Finding):
                    document = read_document(folder, seed)
                    if layout.state_of(document) != layout.RUNNING:
                        writer.finish(facts(document))
                writer.close()
