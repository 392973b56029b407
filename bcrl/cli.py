"""The `bcrl` command: plans what a command line asks for, and runs it in one pool.

Slow imports are made where they are needed, so that Tab and --help don't wait.
"""

from __future__ import annotations

import os
import sys
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from bcrl.common.files import make_directory
from bcrl.common.signals import EXIT_CODE, Interrupted, heard
from bcrl.common.terminal import ready, say, show
from bcrl.config import flags
from bcrl.config.describe import describe
from bcrl.config.hydra_compose import CONF, CONFIG_NAME, register_plugins, searchpath
from bcrl.errors import BcrlError

if TYPE_CHECKING:
    from bcrl.config.plan import Plan

FULL_ERROR = "HYDRA_FULL_ERROR"


def main() -> None:
    """Console entry point; rejects bad input with one message before any work."""
    ready()
    try:
        with _one_message():
            if not sys.argv[1:]:
                show(flags.short())
                sys.exit(2)
            plans = _planned(flags.arguments())
            if plans:
                make_directory(plans[0].root, "runs_dir")
        if plans:
            from bcrl.run import runner

            heard()
            runner.run(*plans)
    except BcrlError as error:
        sys.exit(_complain(error))
    except (Interrupted, KeyboardInterrupt):
        say("bcrl: interrupted; run the same command again to resume")
        sys.exit(EXIT_CODE)


def _planned(asked: Namespace) -> list[Plan]:
    """The plans to run here; none if something is shown, or Slurm has run them."""
    if asked.experimental_rerun:
        raise BcrlError("--experimental-rerun: unpickles a file, which isn't supported")
    if asked.config_path:
        raise BcrlError("--config-path: add your folder with --config-dir")
    if asked.help:
        show(flags.manual(asked.config_dir))
        return []
    if asked.describe is not None:
        show(describe(asked.describe))
        return []
    if asked.shell_completion and any(o[:6] == "query=" for o in asked.overrides):
        show("\n".join(flags.completions(os.environ.get("COMP_LINE", ""))))
        return []
    if asked.hydra_help or asked.shell_completion:
        _by_hydra(asked)
        return []
    from bcrl.config import jobs
    from bcrl.run import records, status

    if asked.status:
        show(status.status(asked))
        return []
    plans = jobs.plans(asked)
    if asked.cfg or asked.info:
        _by_hydra(asked)
        return []
    for plan in plans:
        records.check_directory(plan)
    if asked.dry_run:
        show(status.dry_run(plans))
        return []
    if plans[0].launched:
        from bcrl.run import launchers, runner

        launchers.register_slurm()
        heard()
        _by_hydra(asked)
        runner.check_complete(plans)
        return []
    return plans


def _run_job(composed: DictConfig) -> int:
    """One job of Slurm's; its exit code.

    An error is reported and no more: other jobs continue, and their files show it.
    """
    from bcrl.config import jobs
    from bcrl.run import runner

    GlobalHydra.instance().clear()  # Hydra has composed; here it composes to compare
    try:
        runner.run(jobs.plan_of_job(composed, HydraConfig.get()))
    except BcrlError as error:
        return _complain(error)
    return 0


def _by_hydra(asked: Namespace) -> None:
    """Have Hydra show something, or launch jobs."""
    register_plugins()
    folders = searchpath(getattr(asked, "folders", ()))
    sys.argv[1:] = [*flags.for_hydra(asked), *asked.overrides, *folders]
    # Not a decorator: a launcher's process looks for the plain function by its name.
    hydra.main(version_base="1.3", config_path=str(CONF), config_name=CONFIG_NAME)(
        _run_job
    )()


@contextmanager
def _one_message() -> Iterator[None]:
    """Make a BcrlError of whatever goes wrong; HYDRA_FULL_ERROR=1 shows where."""
    before = os.environ.get(FULL_ERROR)
    os.environ[FULL_ERROR] = "1"  # Hydra would print a traceback and exit
    try:
        yield
    except BcrlError:
        raise
    except Exception as error:
        if before == "1":
            raise
        if isinstance(error.__cause__, BcrlError):  # as in what Hydra instantiates
            raise error.__cause__ from None
        words = " ".join(str(error).split()) or "no further words"
        why = f"{type(error).__name__}: {words}; {FULL_ERROR}=1 shows where"
        raise BcrlError(why) from error
    finally:
        os.environ.pop(FULL_ERROR)
        os.environ.update({} if before is None else {FULL_ERROR: before})


def _complain(error: BcrlError) -> int:
    say(f"bcrl: {error}")
    return error.exit_code


if __name__ == "__main__":
    from bcrl.cli import main as command  # `_run_job` has to be found by its name

    command()
