"""What a shell asks for before any work: the flags, the help, what Tab completes."""

from __future__ import annotations

import argparse
import os
import sys
import textwrap
from argparse import Namespace
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path
from string import Template
from typing import NoReturn

from hydra._internal.utils import get_args_parser

from bcrl import __version__
from bcrl.common.files import user_folder
from bcrl.config.bounds import check_override
from bcrl.config.hydra_compose import CONF, PACKAGE
from bcrl.errors import BcrlError, closest

HELP = PACKAGE / "config" / "help.txt"
WIDTH, HANGING = 88, 21  # columns of the help, and where an option's text begins
LINE = "COMP_LINE"  # the environment variable with the line that Tab is to complete


def arguments() -> Namespace:
    """What the command line asks for; BcrlError for a flag that there isn't.

    Its `flags` are all words but the overrides. A folder of configs that isn't named is
    the user's own, if there is one.
    """
    flags, words = parser(), sys.argv[1:]
    for place, word in enumerate(words):
        if word == "--":
            break
        check_override(word)
        if word.startswith("-") and not _is_flag(word, flags):
            raise BcrlError(f"{word}: unknown flag; {_meant(words, place, flags)}")
    asked = flags.parse_intermixed_args()
    if asked.runs_dir is not None:
        quoted = asked.runs_dir.replace('"', r"\"")
        asked.overrides.append(f'runs_dir="{quoted}"')
    asked.flags = _without(sys.argv[1:], asked)
    folder = asked.config_dir
    if asked.shell_completion:
        folder = _completed(flags).config_dir
    if folder is None and (own := own_folder()):
        folder = str(own)
    if folder is not None:  # a launcher's process may be in another
        folder = os.path.abspath(folder)
        asked.flags.append(f"--config-dir={folder}")
    asked.config_dir = folder
    return asked


def _is_flag(word: str, flags: argparse.ArgumentParser) -> bool:
    """Whether a word is a flag, may be abbreviated and with its value."""
    name = word.partition("=")[0]
    known = [each for action in flags._actions for each in action.option_strings]
    short = [each for each in known if len(each) <= 3 and each[:2] != "--"]
    return name in known or (
        any(each.startswith(name) for each in known)
        if name.startswith("--")
        else all(f"-{letter}" in short for letter in name[1:]) and len(name) > 1
    )


def _meant(words: Sequence[str], place: int, flags: argparse.ArgumentParser) -> str:
    """What a flag that there isn't probably means."""
    from bcrl.config.hints import Hints

    word = words[place]
    follow = takewhile(lambda w: "=" not in w and w[:1] != "-", words[place + 1 :])
    value = next(follow, None)
    if value and value.isdecimal():  # --seeds 0 1 2
        value = " ".join([value, *takewhile(str.isdecimal, follow)])
    chosen = tuple(each for each in words if "=" in each and not each.startswith("-"))
    names = set(_names(flags)) - {"--runs-dir"}  # its key says as much
    near = closest(word.partition("=")[0], names, 0.7)
    line = near or Hints(chosen).words(word, value) or closest(word, names, 0.6)
    return f"did you mean {line}?" if line else "see bcrl --help"


def _without(words: Sequence[str], asked: Namespace) -> list[str]:
    """The words that are Hydra's flags: no overrides, and not the results' folder."""
    kept, ours = [], False
    for word in words:
        if (
            not ours
            and word not in asked.overrides
            and not word.startswith("--runs-dir")
        ):
            kept.append(word)
        ours = word == "--runs-dir"
    return kept


def parser() -> argparse.ArgumentParser:
    """Hydra's flags and ours."""
    result = get_args_parser()
    result.prog = "bcrl"
    shown = next(a for a in result._actions if "--version" in a.option_strings)
    shown.version, shown.help = f"bcrl {__version__}", "show bcrl's version"
    about = "explain a key or group; without KEY, list all keys"
    result.add_argument("--describe", metavar="KEY", nargs="?", const="", help=about)
    result.add_argument("--dry-run", action="store_true", help="list jobs and costs")
    result.add_argument("--runs-dir", metavar="PATH", help="as runs_dir=PATH")
    result.error = _refuse
    result.add_argument("--status", action="store_true", help="list what is done")
    return result


def _refuse(message: str) -> NoReturn:
    raise BcrlError(f"{message}; see bcrl --help")


def short() -> str:
    """What `bcrl` alone shows: what it is, examples, and where more is said."""
    title, _, rest = manual(None).partition("\n")
    examples = rest.partition("\nExamples\n")[2].partition("\n\n")[0]
    return f"{title}\n\n{examples}\n\nbcrl --help shows groups, keys, flags and more."


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
        typed, _ = flags.parse_known_intermixed_args(words)
    except BcrlError:  # a flag's own argument is missing: the shell proposes files
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
