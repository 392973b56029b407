"""What a shell asks for before any work: the flags, the help, what Tab completes."""

from __future__ import annotations

import argparse
import os
import sys
import textwrap
from argparse import Namespace
from contextlib import redirect_stderr
from pathlib import Path
from string import Template

from hydra._internal.utils import get_args_parser

from bcrl import __version__
from bcrl.composed import CONF, PACKAGE
from bcrl.errors import BcrlError, guess

HELP = PACKAGE / "help.txt"
WIDTH, HANGING = 88, 21  # columns of the help, and where an option's text begins
LINE = "COMP_LINE"  # the environment variable with the line that Tab is to complete


def arguments() -> Namespace:
    """What the command line asks for; BcrlError for a flag that there isn't.

    Its `flags` are all words but the overrides. A folder of configs that isn't named is
    the user's own, if there is one.
    """
    flags = parser()
    asked, unknown = flags.parse_known_intermixed_args()
    if unknown:
        close = guess(unknown[0].partition("=")[0], _names(flags))
        raise BcrlError(f"{unknown[0]}: unknown flag; {close or 'see bcrl --help'}")
    asked.flags = [word for word in sys.argv[1:] if word not in asked.overrides]
    folder = asked.config_dir
    if asked.shell_completion:
        folder = _completed(flags).config_dir
    if folder is None and own_folder().is_dir():
        folder = str(own_folder())
    if folder is not None:  # a launcher's process may be in another
        folder = os.path.abspath(folder)
        asked.flags.append(f"--config-dir={folder}")
    asked.config_dir = folder
    return asked


def parser() -> argparse.ArgumentParser:
    """Hydra's flags and ours."""
    result = get_args_parser()
    result.prog = "bcrl"
    shown = next(a for a in result._actions if "--version" in a.option_strings)
    shown.version, shown.help = f"bcrl {__version__}", "show bcrl's version"
    result.add_argument("--dry-run", action="store_true", help="list jobs and costs")
    result.add_argument("--status", action="store_true", help="list what is done")
    return result


def own_folder() -> Path:
    """The user's folder of configs, which need not be there: ~/.config/bcrl."""
    base = os.environ.get("XDG_CONFIG_HOME") or os.path.expanduser("~/.config")
    return Path(base, "bcrl")


def manual(config_dir: str | None) -> str:
    """The help, with the options of every group, those of a folder of one's own too."""
    folders = [CONF, *([Path(config_dir)] if config_dir else [])]
    text = Template(HELP.read_text())
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
        with open(os.devnull, "w") as nowhere, redirect_stderr(nowhere):
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
