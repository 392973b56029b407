"""What a shell asks for before any work: the flags, the help, what Tab completes."""

from __future__ import annotations

import argparse
import io
import os
import sys
import textwrap
import time
from argparse import Namespace
from contextlib import redirect_stderr
from pathlib import Path
from string import Template

from hydra._internal.utils import get_args_parser

from bcrl.composed import CONF, PACKAGE
from bcrl.errors import BcrlError, guess
from bcrl.files import user_folder

HELP = PACKAGE / "help.txt"
WIDTH, HANGING = 88, 21  # columns of the help, and where an option's text begins
STARTED = "BCRL_STARTED"  # when the command began: a debug run's folder
LINE = "COMP_LINE"  # the environment variable with the line that Tab is to complete


def arguments() -> Namespace:
    """What the command line asks for; BcrlError for a flag that there isn't.

    `sys.argv` is put into the order that Hydra wants, flags first; people write them
    anywhere. A folder of configs that isn't named is the user's own, if there is one.
    """
    os.environ.setdefault(STARTED, time.strftime("%Y-%m-%d_%H-%M-%S"))
    flags = parser()
    asked, unknown = flags.parse_known_intermixed_args()
    if unknown:
        close = guess(unknown[0].partition("=")[0], _names(flags))
        raise BcrlError(f"{unknown[0]}: unknown flag; {close or 'see bcrl --help'}")
    given = [word for word in sys.argv[1:] if word not in asked.overrides]
    folder = asked.config_dir
    if asked.shell_completion:
        folder = _completed(flags).config_dir
    if folder is None and (own := own_folder()):
        folder = str(own)
    if folder != asked.config_dir:
        given.append(f"--config-dir={folder}")
    asked.config_dir = folder
    sys.argv[1:] = given + asked.overrides
    return asked


def parser() -> argparse.ArgumentParser:
    """Hydra's flags and ours."""
    result = get_args_parser()
    result.prog = "bcrl"
    result.add_argument("--dry-run", action="store_true", help="list jobs and costs")
    result.add_argument("--status", action="store_true", help="list what is done")
    return result


def own_folder() -> Path | None:
    """The user's folder of configs, ~/.config/bcrl, if it is there."""
    base = user_folder("XDG_CONFIG_HOME", ".config")
    return base / "bcrl" if base and (base / "bcrl").is_dir() else None


def manual(config_dir: str | None) -> str:
    """The help, with the options of every group, those of a folder of one's own too."""
    folders = [CONF, *([Path(config_dir)] if config_dir else [])]
    text = Template(HELP.read_text("utf-8"))
    options = {
        name: ", ".join(_options(folders, name.replace("__", "/")))
        for name in text.get_identifiers()
    }
    lines = text.substitute(options).splitlines()
    hanging = " " * HANGING
    wrapped = [textwrap.fill(x, WIDTH, subsequent_indent=hanging) for x in lines]
    return "\n".join(wrapped)


def _options(folders: list[Path], group: str) -> list[str]:
    found = (path.stem for folder in folders for path in folder.glob(f"{group}/*.yaml"))
    return sorted(dict.fromkeys(found), key=str.lower)


def _completed(flags: argparse.ArgumentParser) -> Namespace:
    """The line that is being completed, taken apart, its flags taken out for Hydra.

    A flag is completed here.
    """
    line = os.environ.get(LINE, "")
    words = line.split()[1:]
    if words and words[-1].startswith("-") and not line[-1].isspace():
        print(*(name for name in _names(flags) if name.startswith(words[-1])))
        sys.exit(0)
    try:
        with redirect_stderr(io.StringIO()):
            typed, _ = flags.parse_known_intermixed_args(words)
    except SystemExit:  # a flag's own argument is missing: the shell proposes files
        sys.exit(0)
    chosen = any(o.startswith(("env=", "experiment=")) for o in typed.overrides)
    # Without an env nothing composes; most keys are the same in all of them.
    supposed = ["env=maze"] * (not chosen)
    left = ["bcrl", *["-m"] * typed.multirun, *supposed, *typed.overrides]
    os.environ[LINE] = " ".join(left) + " " * (line[-1:].isspace() or len(left) == 1)
    return typed


def _names(flags: argparse.ArgumentParser) -> list[str]:
    """Every flag, short ones too."""
    words = flags.format_usage().replace("[", " ").replace("]", " ").split()
    return sorted({word for word in words if word.startswith("-")})
