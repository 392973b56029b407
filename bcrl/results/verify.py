"""`bcrl-verify`: whether all results in a folder are whole, unchanged and in place."""

import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from bcrl.common.terminal import ready, say, show
from bcrl.errors import BcrlError
from bcrl.results.arguments import ResultsParser
from bcrl.results.integrity import check_tree
from bcrl.results.read import BROKEN

_ABOUT = """Check every result file of a folder: hashes, places, configs, order, missing
seeds. Exit code: 0 nothing wrong, 1 runs are incomplete, 2 broken, or no runs."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Print one line per finding, then a summary; the exit code as `--help` says."""
    ready()
    parser = ResultsParser(prog="bcrl-verify", description=_ABOUT)
    parser.add_argument("path", type=Path, nargs="?", help="the same as runs_dir=PATH")
    try:
        options = parser.parsed(arguments)
    except BcrlError as error:
        say(f"bcrl-verify: {error}")
        return 2
    runs_dir = options.path or options.runs_dir
    variants, findings = check_tree(runs_dir)
    for finding in findings:
        show(f"{finding.kind}: {finding}")
    if not variants:
        why = "holds no runs" if runs_dir.is_dir() else "is not a folder"
        say(f"bcrl-verify: {runs_dir} {why}; name a runs_dir")
        return 2
    shown = f"{len(variants)} variants, {sum(len(v.tables) for v in variants)} seeds"
    counts = Counter(finding.kind for finding in findings)
    wrong = ", ".join(f"{n} {kind}" for kind, n in counts.items()) or "nothing wrong"
    show(f"{shown} complete; {wrong}")
    return 2 if counts[BROKEN] else 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
