"""The suite of misleading curricula: python -m research.misleading run|table.

`run` trains what has no file yet, `table` writes tables and figures from the files.
docs/explanation/negative_transfer.md has the protocol.
"""

import argparse
import sys
from pathlib import Path

from bcrl.common.files import make_directory
from bcrl.errors import BcrlError
from research.misleading_runs import jobs_of, train
from research.misleading_tasks import SETTINGS, smoke


def main(words: list[str] | None = None) -> int:
    """The command; its exit code."""
    parser = argparse.ArgumentParser(prog="python -m research.misleading")
    parser.add_argument("what", choices=("run", "table"))
    parser.add_argument("--seeds", type=int, default=20, help="how many, from --first")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--out", type=Path, default=Path("runs/misleading"))
    parser.add_argument("--env", nargs="+", choices=SETTINGS, default=[*SETTINGS])
    parser.add_argument("--to", type=Path, default=Path("docs/results"))
    parser.add_argument("--smoke", action="store_true", help="tiny budgets, a trial")
    given = parser.parse_args(words)
    if min(given.seeds, given.workers) < 1 or given.first < 0:
        parser.error("--seeds and --workers must be at least 1, --first at least 0")
    change = smoke if given.smoke else (lambda setting: setting)
    settings = {env: change(SETTINGS[env]) for env in given.env}
    seeds = range(given.first, given.first + given.seeds)
    jobs = [
        x for env, setting in settings.items() for x in jobs_of(env, setting, seeds)
    ]
    if given.what == "run":
        return train(jobs, given.out, given.workers)
    from research.misleading_tables import write  # matplotlib is slow to import

    try:
        make_directory(given.to, "--to")
        print(*write(settings, jobs, given.out, given.to), sep="\n")
    except BcrlError as error:
        parser.error(str(error))
    return 0


if __name__ == "__main__":
    sys.exit(main())
