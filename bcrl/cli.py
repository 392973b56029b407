"""The `bcrl` command: plans what a command line asks for, and runs it in one pool.

Slow imports are made where they are needed, so that Tab and --help don't wait.
"""

import os
import sys
from argparse import Namespace

import hydra

from bcrl.common.files import make_directory
from bcrl.common.signals import EXIT_CODE, Interrupted
from bcrl.common.terminal import ready, say, show
from bcrl.config import flags
from bcrl.config.describe import describe
from bcrl.config.hydra_compose import CONF, CONFIG_NAME, register_plugins, searchpath
from bcrl.errors import BcrlError

FULL_ERROR = "HYDRA_FULL_ERROR"


def main() -> None:
    """Console entry point; rejects bad input with one message before any work."""
    ready()
    try:
        if not sys.argv[1:]:
            show(flags.short())
            sys.exit(2)
        asked = flags.arguments()
        if not _shown(asked) and (plans := _checked(asked)):
            from bcrl.run import runner

            runner.run(*plans)
    except (Interrupted, KeyboardInterrupt):
        say("bcrl: interrupted; run the same command again to resume")
        sys.exit(EXIT_CODE)
    except BcrlError as error:
        say(f"bcrl: {error}")
        sys.exit(error.exit_code)
    except Exception as error:
        if os.environ.get(FULL_ERROR) == "1":
            raise
        why = " ".join(f"{type(error).__name__}: {error}".split())
        say(f"bcrl: {why}; {FULL_ERROR}=1 shows where")
        sys.exit(BcrlError.exit_code)


def _shown(asked: Namespace) -> bool:
    """Whether a flag asks for something that needs no plan; it is shown then."""
    if asked.experimental_rerun:
        raise BcrlError("--experimental-rerun: unpickles a file, which isn't supported")
    if asked.config_path:
        raise BcrlError("--config-path: add your folder with --config-dir")
    if asked.help:
        show(flags.manual(asked.config_dir))
    elif asked.describe is not None:
        show(describe(asked.describe))
    elif asked.shell_completion and any(o[:6] == "query=" for o in asked.overrides):
        show("\n".join(flags.completions(os.environ.get("COMP_LINE", ""))))
    elif asked.hydra_help or asked.shell_completion:
        _show_by_hydra(asked)
    else:
        return False
    return True


def _checked(asked: Namespace) -> list:
    """The checked plans to run here; none if nothing is left to run."""
    from bcrl.config import jobs
    from bcrl.run import records, status

    if asked.status:
        show(status.status(asked))
        return []
    if asked.send_complete:
        from bcrl.run import sending

        show(sending.send(asked))
        return []
    plans = jobs.plans(asked)
    if asked.cfg or asked.info:
        _show_by_hydra(asked)
        return []
    for plan in plans:
        records.check_directory(plan)
    if asked.dry_run:
        show(status.dry_run(plans))
        return []
    make_directory(plans[0].root, "runs_dir")
    if plans[0].launcher:
        from bcrl.run import launchers

        launchers.launch(plans)
        return []
    return plans


def _show_by_hydra(asked: Namespace) -> None:
    """Have Hydra show something: a config, its own help, a script for the shell."""
    register_plugins()
    folders = searchpath(getattr(asked, "folders", ()))
    sys.argv[1:] = [*flags.for_hydra(asked), *asked.overrides, *folders]
    shows = hydra.main(str(CONF), CONFIG_NAME, version_base="1.3")
    before = os.environ.get(FULL_ERROR, "0")
    os.environ[FULL_ERROR] = "1"  # so that Hydra raises its errors
    try:
        shows(lambda _: None)()
    finally:
        os.environ[FULL_ERROR] = before


if __name__ == "__main__":
    main()
