"""The `bcrl` command: vets what Hydra composes, then runs it, all jobs in one pool.

What takes long to import is imported where it is needed: Tab and --help don't wait.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from typing import TYPE_CHECKING

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from bcrl.common.files import make_directory
from bcrl.common.signals import EXIT_CODE, Interrupted, heard
from bcrl.common.terminal import ready, say, show
from bcrl.config import guard, shell
from bcrl.config.describe import describe
from bcrl.config.hydra_compose import CONF, CONFIG_NAME
from bcrl.errors import BcrlError

if TYPE_CHECKING:
    from bcrl.config.plan import Plan


def main() -> None:
    """Console entry point; refuses bad input with one message before any work."""
    ready()
    guard.register()
    try:
        with guard.refusals():
            if not sys.argv[1:]:
                show(shell.short())
                sys.exit(2)
            arguments = shell.arguments()
            if arguments.help:
                show(shell.manual(arguments.config_dir))
                return
            if arguments.describe is not None:
                show(describe(arguments.describe))
                return
            if plans := _vet(arguments):
                make_directory(plans[0].root, "runs_dir")
        if plans:
            from bcrl.run import runner

            heard()
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
        _by_hydra(arguments)
        return []
    from bcrl.config import vetting
    from bcrl.run import records, status

    if arguments.status:
        show(status.status(arguments))
        return []
    plans = vetting.plans(arguments)
    if not (arguments.cfg or arguments.info):
        for plan in plans:
            records.check_directory(plan)
    if arguments.dry_run:
        show(status.dry_run(plans))
        return []
    if arguments.cfg or arguments.info:
        _by_hydra(arguments)
        return []
    if vetting.left_to_hydra(arguments):
        from bcrl.run import launchers, runner

        launchers.register_slurm()
        heard()
        _by_hydra(arguments)
        runner.check_complete(plans)
        return []
    return plans


def _run_job(composed: DictConfig) -> int:
    """One job of Hydra's, perhaps in a process of a launcher's; its exit code.

    An error is said and no more: other jobs go on, and in the end their files tell.
    """
    from bcrl.config import vetting
    from bcrl.run import runner

    guard.register()
    GlobalHydra.instance().clear()  # Hydra has composed; vetting does, to compare
    try:
        runner.run(vetting.job(composed, HydraConfig.get()))
    except BcrlError as error:
        return _complain(error)
    return 0


def _by_hydra(arguments: Namespace) -> None:
    """Have Hydra do what is asked for, given the words in the order that it wants."""
    sys.argv[1:] = [*arguments.flags, *arguments.overrides]
    # Not a decorator: a launcher's process looks for the plain function by its name.
    hydra.main(version_base="1.3", config_path=str(CONF), config_name=CONFIG_NAME)(
        _run_job
    )()


def _complain(error: BcrlError) -> int:
    say(f"bcrl: {error}")
    return error.exit_code


if __name__ == "__main__":
    from bcrl.cli import main as command  # `_run_job` has to be found by its name

    command()
