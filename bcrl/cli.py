"""The `bcrl` command: vets what Hydra composes, then runs it, all jobs in one pool."""

from __future__ import annotations

import sys
from argparse import Namespace

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from bcrl import guard, launching, records, runner, vetting
from bcrl.compose import Plan
from bcrl.errors import BcrlError
from bcrl.files import make_directory
from bcrl.interrupts import EXIT_CODE, Interrupted
from bcrl.terminal import say

#: Exit codes, besides 0: seeds failed; bad input or no place to write; a signal.
FAILED, REFUSED, INTERRUPTED = 1, 2, EXIT_CODE


def main() -> None:
    """Console entry point; refuses bad input with one message before any work."""
    guard.register()
    launching.register()
    arguments = get_args_parser().parse_intermixed_args()
    # Hydra wants the options before the overrides; people write them anywhere.
    options = [a for a in sys.argv[1:] if a not in arguments.overrides]
    sys.argv[1:] = options + arguments.overrides
    try:
        with guard.refusals():
            plans = _vet(arguments)
            by_hydra = not plans or vetting.left_to_hydra(arguments)
            if by_hydra:
                _by_hydra()
            else:
                make_directory(plans[0].root, "runs_dir")
        if by_hydra:
            runner.check_complete(plans)
        else:
            runner.run(*plans)
    except runner.SeedsFailed as error:
        sys.exit(_complain(error, FAILED))
    except BcrlError as error:
        sys.exit(_complain(error, REFUSED))
    except (Interrupted, KeyboardInterrupt):
        text = "interrupted; run the same command again to go on from here"
        say(f"bcrl: {text}")
        sys.exit(INTERRUPTED)


def _vet(arguments: Namespace) -> list[Plan]:
    """The plans to run; none if the command line only wants to be shown something."""
    if arguments.experimental_rerun:
        raise BcrlError("--experimental-rerun: unpickles a file, which isn't supported")
    if arguments.config_path:
        raise BcrlError("--config-path: add a folder of your own with --config-dir")
    if arguments.help or arguments.hydra_help or arguments.shell_completion:
        # Hydra composes for --help too, and env is a required choice.
        if not any(o.startswith(("env=", "experiment=")) for o in arguments.overrides):
            sys.argv += ["env=maze"] * arguments.help
        return []
    plans = vetting.plans(arguments)
    if arguments.cfg or arguments.info:
        return []
    for plan in plans:
        records.check_directory(plan)
    return plans


def _run_job(composed: DictConfig) -> int:
    """One job of Hydra's, perhaps in a process of a launcher's; its exit code.

    An error is said and no more: other jobs go on, and in the end their files tell.
    """
    guard.register()
    GlobalHydra.instance().clear()  # Hydra has composed; vetting does, to compare
    try:
        runner.run(vetting.job(composed, HydraConfig.get()))
    except runner.SeedsFailed as error:
        return _complain(error, FAILED)
    except BcrlError as error:
        return _complain(error, REFUSED)
    return 0


#: Not a decorator: a process of a launcher's looks for the plain function by its name.
_by_hydra = hydra.main(
    version_base="1.3", config_path=str(vetting.CONF), config_name=vetting.CONFIG_NAME
)(_run_job)


def _complain(error: BcrlError, code: int) -> int:
    say(f"bcrl: {error}")
    return code
