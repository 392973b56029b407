"""Arguments of `bcrl-report` and `bcrl-verify`: `key=VALUE` or `--key VALUE`."""

from __future__ import annotations

import argparse
import sys
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from bcrl import __version__
from bcrl.errors import BcrlError, closest

#: Words that people type → the flag that they mean.
_HABITS = {
    "help": "--help",
    "version": "--version",
    "v": "--version",
    "output": "--out",
}
_HABITS |= {"out_dir": "--out", "results": "--runs-dir", "dir": "--runs-dir"}
_SCALES = ("smoke", "quick", "paper", "search")


class ResultsParser(argparse.ArgumentParser):
    """A parser that raises a BcrlError, with the words to type, for bad arguments."""

    def __init__(self, prog: str, description: str) -> None:
        super().__init__(prog=prog, description=description)
        self.add_argument("--version", action="version", version=f"bcrl {__version__}")
        text = "the results, also runs_dir=PATH as bcrl has it; default: %(default)s"
        add, runs = self.add_argument, Path("runs")
        add("--runs-dir", type=Path, default=runs, metavar="PATH", help=text)

    def parsed(self, words: Sequence[str] | None = None) -> Namespace:
        """The options in `words` or on the command line; BcrlError for a bad one."""
        given = [self._spelt(w) for w in (sys.argv[1:] if words is None else words)]
        options, left = self.parse_known_args(given)
        if left:
            place = given.index(left[0]) if left[0] in given else len(given) - 1
            word, after = given[place], "".join(given[place + 1 : place + 2])
            raise BcrlError(f"{word}: unknown; {self._meant(word, after)}")
        return options

    def error(self, message: str) -> NoReturn:
        """Raise BcrlError."""
        raise BcrlError(f"{message}; see {self.prog} --help")

    def _flags(self) -> list[str]:
        return [flag for each in self._actions for flag in each.option_strings]

    def _spelt(self, word: str) -> str:
        """`runs_dir=PATH` and `--runs_dir=PATH` as `--runs-dir=PATH`."""
        key, equals, value = word.partition("=")
        flag = f"--{key.removeprefix('--').replace('_', '-')}"
        known = flag in self._flags() and (equals or key.startswith("--"))
        return flag + equals + value if known else word

    def _meant(self, word: str, after: str) -> str:
        """What an unknown word may mean, as the words to type."""
        key, _, value = word.lstrip("+-").partition("=")
        value, name = value or after, key.lower().replace("-", "_").rstrip(":")
        flags = self._flags()
        flag = _HABITS.get(name) or closest(f"--{name.replace('_', '-')}", flags, 0.6)
        if "--scale" in flags and (scale := closest(word, _SCALES, 0.8)):
            flag, value = "--scale", scale
        elif Path(word).is_dir() and not word.startswith("-"):
            flag, value = "--runs-dir", word
        if flag not in flags:
            return f"see {self.prog} --help"
        if flag == "--runs-dir":
            return f"did you mean runs_dir={value or 'PATH'}?"
        return f"did you mean {' '.join(filter(None, (flag, value)))}?"
