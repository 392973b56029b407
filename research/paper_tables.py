"""docs/results/tables.md from the runs: python -m research.paper_tables runs.

The claims with the paper's options and with the released ones, both readings of
boosting, the constants of the paper's text, and the searches. docs/results.md lists the
commands of the runs.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from bcrl.common.files import write_text
from bcrl.common.text import estimate, number
from bcrl.report import tables
from bcrl.report.claims import claims_sections
from bcrl.report.load import load_runs
from bcrl.report.tables import Section, TextTable
from bcrl.report.variants import COMPARED, LINEAR, Runs, Variant
from bcrl.results.layout import spelled
from bcrl.results.statistics import bootstrap
from research.line_search import frequency_of

HEAD = """# Tables of all results

These are the numbers behind [Results](../results.md), written by
`python -m research.paper_tables runs`; all runs are of revision {revision}.
[Metrics](../reference/metrics.md) defines the quantities, the
[glossary](../reference/glossary.md) the methods. IQM is the interquartile mean.
"""
READINGS = """Late returns with the constants of the released code. F is the number of
steps between two copies to the target network; 2000 and 4000 are the published ones of
BC-DQN and of SC- and SBC-DQN.
"""
CONSTANTS = """`experiment=fig4` against `experiment=fig4_paper`, which has the
constants of the paper's text.
"""
SEARCHES = """`make searches` runs other seeds than all results: {seeds}. Late returns;
there is no interval where all seeds never arrived. The searches over F:
"""


class Key(NamedTuple):
    """What tells the runs in the linear system apart."""

    method: str
    reading: str  # "paper" or "released"
    frequency: int  # F in the target
    preset: str = "released"  # of the environment's constants


def key_of(variant: Variant) -> Key | None:
    """The key of a run; None of a line search, which another page is about."""
    config = variant.config
    if config["boosting"].get("alpha", 1.0) != 1.0:
        return None
    released = config["boosting"].get("greedy_on") == "residual"
    released |= config["transfer"].get("zero_at_goal") is False
    frequency = frequency_of(variant)
    reading = "released" if released else "paper"
    return Key(variant.method, reading, frequency, config["env"]["preset"])


def linear(runs: Runs) -> dict[Key, Variant]:
    """DQN's runs in the linear system by what they are."""
    keys = {key_of(v): v for v in runs.of(LINEAR, "DQN")}
    return {key: variant for key, variant in keys.items() if key is not None}


def late(variant: Variant | None, metric: str = "return") -> str:
    """The mean over seeds of late values and its interval; a dash without a run."""
    if variant is None:
        return "–"
    values = variant.late(metric)
    low, high = bootstrap(values)
    mean = values.mean()
    return number(mean) if low == high else estimate(mean, (low, high))


def readings(found: dict[Key, Variant]) -> Iterator[dict[str, str]]:
    """Both readings at F = 2000 and 4000."""
    for method in ("BC-DQN", "SC-DQN", "SBC-DQN"):
        for reading in ("paper", "released"):
            for f in (2000, 4000):
                own = found.get(Key(method, reading, f))
                if own is not None:
                    yield {
                        "method": method,
                        "reading": reading,
                        "F": str(f),
                        "seeds": str(len(own.seeds)),
                        "late return": late(own),
                        "late success rate": late(own, "success_rate"),
                    }


def constants(found: dict[Key, Variant]) -> Iterator[dict[str, str]]:
    """Both presets of the constants."""
    for method in COMPARED[LINEAR, "DQN"]:
        of = [
            next((v for k, v in found.items() if _published(k, v, method, x)), None)
            for x in ("released", "paper")
        ]
        yield {
            "method": method,
            "released constants: late return": late(of[0]),
            "the text's constants: late return": late(of[1]),
            "late success rate": late(of[1], "success_rate"),
        }


def _published(key: Key, variant: Variant, method: str, preset: str) -> bool:
    """Whether a run is the method of the paper with its published F, in a preset."""
    tag = None if preset == "released" else "paper"
    return (key.method, key.preset, variant.tag) == (method, preset, tag)


def over_frequencies(runs: Runs) -> Iterator[dict[str, str]]:
    """The searches over F: a row per F, a column per method and reading."""
    found = {k: v for k, v in linear(runs).items() if _searched(v) == {"target_update"}}
    columns = sorted({(k.method, k.reading) for k in found}, key=str)
    for f in sorted({k.frequency for k in found}):
        row = {"F": str(f)}
        for method, reading in columns:
            name = method if reading == "paper" else f"{method}, released"
            row[name] = late(found.get(Key(method, reading, f)))
        yield row


def over_others(runs: Runs) -> Iterator[dict[str, str]]:
    """The searches over ν and the offset."""
    for variant in runs.of(LINEAR, "DQN"):
        for key in ("nu", "offset"):
            if _searched(variant) == {key}:
                value = variant.config["transfer"][key]
                name = f"{variant.method}, {key} = {value}"
                yield {"searched": name, "late return": late(variant)}


def _searched(variant: Variant) -> set[str]:
    """The keys that the command of a search varied."""
    command = str(variant.sidecars[0].get("command"))
    return {k for k in ("target_update", "nu", "offset") if f".{k}=" in command}


def revisions(*every: Runs) -> str:
    """The revision of all runs; SystemExit if there are several."""
    sidecars = [s for runs in every for v in runs.variants for s in v.sidecars]
    found = {s["git"]["revision"][:7] + "+" * s["git"]["dirty"] for s in sidecars}
    if len(found) > 1:
        raise SystemExit(f"the runs are of several revisions: {sorted(found)}")
    return found.pop()


def document(runs: Runs, searches: Runs) -> str:
    """The whole page."""
    found = linear(runs)
    seeds = spelled(searches.variants[0].seeds)
    parts: list[object] = [HEAD.format(revision=revisions(runs, searches))]
    parts += [tables.PARAGRAPHS["claims"], *claims_sections(runs, None).values()]
    own: list[str | TextTable] = [READINGS, TextTable([*readings(found)])]
    parts.append(Section("Both readings of boosting and shaping", own))
    own = [CONSTANTS, TextTable([*constants(found)])]
    parts.append(Section("The constants of the paper's text", own))
    own = [SEARCHES.format(seeds=seeds), TextTable([*over_frequencies(searches)])]
    own += ["The other two:\n", TextTable([*over_others(searches)])]
    parts.append(Section("The searches of appendix C.3", own))
    for section in claims_sections(runs, "released").values():
        title = f"{section.title}, released options"
        parts.append(Section(title, section.parts))
    return "\n".join(map(str, parts))


def main(words: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m research.paper_tables")
    parser.add_argument("runs", type=Path, help="the folder of all results")
    parser.add_argument("--to", type=Path, default=Path("docs/results/tables.md"))
    given = parser.parse_args(words)
    both = [load_runs(given.runs, scale, False) for scale in ("paper", "search")]
    print(write_text(given.to, document(*both)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
