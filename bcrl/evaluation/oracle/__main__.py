"""Print Q* as CSV: `python -m bcrl.oracle car_on_hill --mass 1.2`."""

import argparse
import dataclasses
import sys
from collections.abc import Sequence

from bcrl.common.terminal import ready, say, show
from bcrl.envs import is_finite
from bcrl.errors import BcrlError
from bcrl.evaluation.oracle import ORACLES


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a table; exit code 0, or 2 for arguments that the user can correct."""
    ready()
    parser = argparse.ArgumentParser("python -m bcrl.oracle", description=__doc__)
    commands = parser.add_subparsers(dest="env", required=True, metavar="ENV")
    for name, oracle in ORACLES.items():
        command = commands.add_parser(name, allow_abbrev=False, help=f"Q* of {name}")
        for field in dataclasses.fields(oracle.ENV):
            if field.name != "horizon":  # Q* does not depend on it
                option = {"type": type(field.default), "default": field.default}
                text = f"default {field.default}"
                command.add_argument(f"--{field.name}", help=text, **option)
    chosen = vars(parser.parse_args(arguments))
    oracle = ORACLES[chosen.pop("env")]
    try:
        env = oracle.ENV(**chosen)
        if not getattr(env, "finite", True):
            raise BcrlError(f"{env} has no table: it has infinitely many states")
        show("\n".join(oracle.table(env)))
        if is_finite(env):
            states, q = oracle.reference(env)
            start = (states == env.evaluation_states()).all(-1)
            say(f"V*(s0) = {q[start].max():.12f}")
    except BcrlError as error:
        say(f"python -m bcrl.oracle: {error}")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
