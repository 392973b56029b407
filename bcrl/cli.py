"""The `bcrl` command: vets what Hydra composes, then runs it, all jobs in one pool.

What takes long to import is imported where it is needed: Tab and --help don't wait.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from typing import TYPE_CHECKING

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from bcrl import guard, shell
from bcrl.composed import CONF, CONFIG_NAME
from bcrl.errors import BcrlError
from bcrl.files import make_directory
from bcrl.interrupts import EXIT_CODE, Interrupted
from bcrl.terminal import say, show

if TYPE_CHECKING:
    from bcrl.compose import Plan

_failures: list[int] = []  # exit codes of jobs that Hydra runs, which go on to the next


def main() -> None:
    """Console entry point; refuses bad input with one message before any work."""
    guard.register()
    try:
        with guard.refusals():
            arguments = shell.arguments()
            if arguments.help:
                show(shell.manual(arguments.config_dir))
                return
            if plans := _vet(arguments):
                make_directory(plans[0].root, "runs_dir")
        if plans:
            from bcrl import runner

            runner.run(*plans)
    except BcrlError as error:
        sys.exit(_complain(error))
    except (Interrupted, KeyboardInterrupt):
        text = "interrupted; run the same command again to go on from here"
        say(f"bcrl: {text}")
        sys.exit(EXIT_CODE)


def _vet(arguments: Namespace) -> list[Plan]:
    """The plans to run; none if Hydra does what is asked for, or it is shown here."""
    if arguments.experimental_rerun:
        raise BcrlError("--experimental-rerun: unpickles a file, which isn't supported")
    if arguments.config_path:
        raise BcrlError("--config-path: add a folder of your own with --config-dir")
    if arguments.hydra_help or arguments.shell_completion:
        return _leave_to_hydra()
    from bcrl import overview, records, vetting

    if arguments.status:
        show(overview.status(arguments))
        return []
    plans = vetting.plans(arguments)
    if not (arguments.cfg or arguments.info):
        for plan in plans:
            records.check_directory(plan)
    if arguments.dry_run:
        show(overview.dry_run(plans))
        return []
    if arguments.cfg or arguments.info or vetting.left_to_hydra(arguments):
        return _leave_to_hydra()
    return plans


def _leave_to_hydra() -> list[Plan]:
    """Hydra shows something, or runs the jobs one by one."""
    _run_job()
    sys.exit(max(_failures, default=0))


@hydra.main(version_base="1.3", config_path=str(CONF), config_name=CONFIG_NAME)
def _run_job(composed: DictConfig) -> None:
    """One job of Hydra's: its composed config is planned and run."""
    from bcrl import runner, vetting

    own = HydraConfig.get()
    sources = own.runtime.config_sources
    folders = [source.path for source in sources if source.schema == "file"]
    try:
        runner.run(vetting.plan(composed, own, folders))
    except BcrlError as error:
        if not own.launcher["_target_"].endswith("BasicLauncher"):
            raise  # in a process of the launcher's: it tells Hydra
        _failures.append(_complain(error))


def _complain(error: BcrlError) -> int:
    say(f"bcrl: {error}")
    return error.exit_code
