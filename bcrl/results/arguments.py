"""Arguments of `bcrl-report` and `bcrl-verify`: `key=VALUE` or `--key VALUE`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from bcrl import __version__
from bcrl.errors import BcrlError, closest

#: Words that people type → the flag that they mean, where none is like them.
_HABITS = {"v": "--version", "out-dir": "--out", "results": "--runs-dir"}
_SCALES = ("smoke", "quick", "paper", "search")


class ResultsParser(argparse.ArgumentParser):
    """A parser that raises a BcrlError, with the words to type, for bad arguments."""

    def __init__(self, prog: str, description: str) -> None:
        super().__init__(prog=prog, description=description)
        self.add_argument("--version", action="version", version=f"bcrl {__version__}")
        text = "the results, also runs_dir=PATH as bcrl has it; default: %(default)s"
        add, runs = self.add_argument, Path("runs")
        add("--runs-dir", type=Path, default=runs, metavar="PATH", help=text)

    def parsed(self, words: Sequence[str] | None = None) -> argparse.Namespace:
        """The options in `words` or on the command line; BcrlError for a bad one."""
        flags = [flag for each in self._actions for flag in each.option_strings]
        given = []
        for word in sys.argv[1:] if words is None else words:
            key, equals, value = word.partition("=")
            flag = f"--{key.removeprefix('--').replace('_', '-')}"
            known = flag in flags and (equals or key.startswith("--"))
            given.append(flag + equals + value if known else word)
        options, left = self.parse_known_args(given)
        if left:
            word = left[0]
            after = given[given.index(word) + 1 :] if word in given else []
            meant = _meant(word, "".join(after[:1]), flags)
            meant = f"did you mean {meant}?" if meant else f"see {self.prog} --help"
            raise BcrlError(f"{word}: unknown; {meant}")
        return options

    def error(self, message: str) -> NoReturn:
        """Raise BcrlError."""
        raise BcrlError(f"{message}; see {self.prog} --help")


def _meant(word: str, after: str, flags: Sequence[str]) -> str:
    """What an unknown word may mean, as the words to type; empty if unknown."""
    key, _, value = word.lstrip("+-").partition("=")
    name = key.lower().replace("_", "-").rstrip(":")
    flag, value = _HABITS.get(name) or closest(f"--{name}", flags, 0.6), value or after
    if "--scale" in flags and (scale := closest(word, _SCALES, 0.8)):
        flag, value = "--scale", scale
    elif Path(word).is_dir() and not word.startswith("-"):
        flag, value = "--runs-dir", word
    if flag == "--runs-dir":
        return f"runs_dir={value or 'PATH'}"
    return f"{flag} {value}".rstrip() if flag in flags else ""
