"""What is odd about the runs, said by name: on the terminal and under the figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bcrl.report.load import Variant


@dataclass(frozen=True)
class Note:
    """One diagnostic: `text` for the terminal, `footer` (if any) for the figures.

    It concerns the figures of `env` that draw the variants tagged `tag`: those with
    `method` in them, or those that compare methods if it is None.
    """

    text: str
    env: str
    tag: str | None
    footer: str = ""
    method: str | None = None


def listed(items: Iterable[object]) -> str:
    """`a, b and c`."""
    *head, last = map(str, items)
    return f"{', '.join(head)} and {last}" if head else last


def ranges(numbers: Iterable[int]) -> str:
    """`0–4, 7` for 0, 1, 2, 3, 4, 7."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(
        str(run[0]) if len(run) == 1 else f"{run[0]}–{run[-1]}" for run in runs
    )


def compared(values: Mapping[str, object]) -> str:
    """`60: FQI and C-FQI; 40: BC-FQI` for a mapping from names to values."""
    groups: dict[object, list[str]] = {}
    for name, value in values.items():
        groups.setdefault(value, []).append(name)
    return "; ".join(f"{value}: {listed(names)}" for value, names in groups.items())


def across_methods(
    methods: Mapping[str, Variant], expected: Iterable[str], env: str, tag: str | None
) -> list[Note]:
    """Notes on compared methods that are absent or that differ in seeds or length."""
    suffix = f"@{tag}" if tag else ""
    notes = []
    absent = [name for name in expected if name not in methods]
    if absent:
        names = listed(name + suffix for name in absent)
        notes.append(
            Note(f"{env}: no runs of {names}", env, tag, f"no runs of {names}")
        )
    seeds = {v.name: ranges(v.seeds) for v in methods.values()}
    if len(set(seeds.values())) > 1:
        text = f"{env}: seeds differ between methods ({compared(seeds)})"
        notes.append(Note(text, env, tag, footer=f"seeds differ: {compared(seeds)}"))
    lengths = {v.name: len(v.stage) for v in methods.values()}
    if len(set(lengths.values())) > 1:
        text = f"{env}: iterations differ between methods ({compared(lengths)})"
        short = f"iterations differ: {compared(lengths)}"
        notes.append(Note(text, env, tag, footer=short))
    optima = {v.name: v.optimum for v in methods.values()}
    if len({o for o in optima.values() if o is not None}) > 1:
        text = f"{env}: optima differ between methods ({compared(optima)})"
        notes.append(Note(text, env, tag, footer="optima differ: none drawn"))
    return notes
