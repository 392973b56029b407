"""Complete seeds are sent to a logger, after their training."""

from argparse import Namespace
from contextlib import closing
from pathlib import Path

from bcrl.common.terminal import say
from bcrl.errors import ConfigError
from bcrl.results import layout, loggers
from bcrl.results.read import read_document, read_recorded
from bcrl.results.tables import parsed
from bcrl.run import records
from bcrl.run.status import asked_folders


def send(arguments: Namespace) -> str:
    """Send a command line's complete seeds, or all in its `runs_dir`; a summary.

    Raises ConfigError without a logger, Finding for a damaged seed.
    """
    sent, left = 0, 0
    for plan, folder, seeds in asked_folders(arguments):
        name = plan.config["logger"]["name"]
        if name == "none":
            raise ConfigError("logger", name, "name one to send to: logger=mlflow")
        made = loggers.logger(plan.config["logger"])
        states = {seed: records.state(folder, seed)[0] for seed in seeds}
        complete = [seed for seed in seeds if states[seed] == layout.COMPLETE]
        for seed in complete:
            _send(made, folder, seed)
        if complete:
            say(f"{folder}: {records.named(complete)} sent to {name}")
        sent, left = sent + len(complete), left + len(seeds) - len(complete)
    return f"{sent} seeds sent, {left} not complete"


def _send(made: loggers.Logger, folder: Path, seed: int) -> None:
    document = read_document(folder, seed)
    path = layout.seed_path(folder, seed, "csv")
    table = parsed(path, read_recorded(path, document), document)
    index = layout.INDEX[layout.family_of(table)][-1]
    run = loggers.run_of(folder, seed, index, document["config"])
    with closing(made.open(run)) as writer:
        for row in table.to_dict("records"):
            loggers.write(writer, index, row)
        writer.finish(loggers.facts(document))
