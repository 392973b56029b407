"""Print Q* as CSV: `python -m bcrl.oracle car_on_hill --mass 1.2`."""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from bcrl.common.terminal import ready
from bcrl.envs import is_finite
from bcrl.errors import BcrlError, did_you_mean
from bcrl.evaluation.oracle import oracles

PIPE_CLOSED = 141  # what a shell reports of a program that SIGPIPE ended


class Parser(argparse.ArgumentParser):
    """An argument parser whose complaints are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}\n")


def parser() -> Parser:
    """A sub-command for each env with an oracle, an option for each of its fields."""
    top = Parser(prog="python -m bcrl.oracle", description=__doc__, allow_abbrev=False)
    commands = top.add_subparsers(dest="env", required=True, metavar="ENV")
    for name, oracle in oracles().items():
        kind = oracle.ENV
        sub = commands.add_parser(name, allow_abbrev=False, help=f"Q* of {name}")
        for field in dataclasses.fields(kind):
            if field.name != "horizon":  # Q* has none
                sub.add_argument(
                    f"--{field.name}",
                    type=type(field.default),
                    default=field.default,
                    help=f"default {field.default}",
                )
    return top


def run(arguments: Sequence[str]) -> None:
    """Print the table of the env that `arguments` name; BcrlError if it has none."""
    top = parser()
    if arguments and arguments[0][:1] != "-" and arguments[0] not in oracles():
        raise BcrlError(
            f"no oracle {arguments[0]}: {did_you_mean(arguments[0], oracles())}"
        )
    chosen = vars(top.parse_args(arguments))
    oracle = oracles()[chosen.pop("env")]
    env = oracle.ENV(**chosen)
    if not getattr(env, "finite", True):
        raise BcrlError(f"{env}: its states are not finitely many, so it has no table")
    for line in oracle.table(env):
        print(line)
    sys.stdout.flush()
    if is_finite(env):
        print(f"V*(s0) = {oracle.start_value(env):.12f}", file=sys.stderr)


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code: 0; 2 for what the user can mend; 1 if output cannot be written."""
    ready()
    try:
        run(sys.argv[1:] if arguments is None else arguments)
    except BcrlError as error:
        print(f"python -m bcrl.oracle: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        # what is still buffered must not fail again at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PIPE_CLOSED
    except OSError as error:
        print(f"python -m bcrl.oracle: cannot write: {error}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
