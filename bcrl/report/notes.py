"""What is odd about the runs, said by name: on the terminal and under the figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bcrl.report.variants import Variant


@dataclass(frozen=True)
class Note:
    """One diagnostic: `text` for the terminal, `footer` (if any) for the figures.

    It concerns the figures of `env` that draw the variants tagged `tag`: those with
    `method` in them, and those that compare the methods of `family`, if one is named.
    `incomplete`: it counts the seeds of a variant that lacks some.
    """

    text: str
    env: str
    tag: str | None
    footer: str = ""
    method: str | None = None
    family: str | None = None
    incomplete: bool = False


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


def tags_shown(methods: Mapping[str, Variant]) -> str:
    """`variants @released`, or who has the tag: `@released: BC-, SC- and SBC-DQN`."""
    tags = {v.tag for v in methods.values()}
    (tag,) = tags - {None} or {None}
    if tag is None or len(tags) == 1:
        return f"variants @{tag}" if tag else ""
    names = [name for name, v in methods.items() if v.tag == tag]
    shared = [name for name in names if name.endswith("-DQN")]
    short = [n.removesuffix("DQN") if n in shared[:-1] else n for n in names]
    return f"@{tag}: {', '.join(short)}"


def remarks(
    notes: Iterable[Note], methods: Mapping[str, Variant], compares: bool = True
) -> list[str]:
    """The lines that belong under a figure of `methods`, which may be of several tags.

    `compares`: differences between methods belong to it too.
    """
    env, family = next((v.env, v.family) for v in methods.values())
    tags = {v.tag for v in methods.values()}

    def belongs(note: Note) -> bool:
        if note.env != env:
            return False
        if note.method in methods and methods[note.method].tag == note.tag:
            return True
        # Of a method that is not drawn: perhaps it has no complete seed.
        awaited = {note.tag} <= tags if note.method else {note.tag} == tags
        return compares and note.family == family and awaited

    shown = [note for note in notes if belongs(note)]
    if compares and len(tags) > 1:  # no notes were made for such a mixture yet
        shown += across_methods(methods, methods, env, None, family)
    lines = [incomplete(shown)]
    odd = [note.footer for note in shown if note.footer and not note.incomplete]
    if odd:
        lines.append("Note: " + "; ".join(odd))
    return [line for line in lines if line]


def incomplete(notes: Iterable[Note]) -> str:
    """`INCOMPLETE: BC-FQI 3 of 20 seeds`; empty if nothing is."""
    counts = [note.footer for note in notes if note.incomplete]
    return f"INCOMPLETE: {', '.join(counts)}" if counts else ""


def across_methods(
    methods: Mapping[str, Variant],
    expected: Iterable[str],
    env: str,
    tag: str | None,
    family: str = "FQI",
) -> list[Note]:
    """Notes on compared methods that are absent or that differ in seeds or length.

    In the DQN family lengths differ by design and aren't compared.
    """
    suffix = f"@{tag}" if tag else ""
    notes = []

    def add(text: str, footer: str) -> None:
        notes.append(Note(text, env, tag, footer, family=family))

    absent = [name for name in expected if name not in methods]
    if absent:
        names = listed(name + suffix for name in absent)
        add(f"{env}: no runs of {names}", f"no runs of {names}")
    seeds = {v.name: ranges(v.seeds) for v in methods.values()}
    if len(set(seeds.values())) > 1:
        text = f"{env}: seeds differ between methods ({compared(seeds)})"
        add(text, f"seeds differ: {compared(seeds)}")
    lengths = {v.name: len(v.stage) for v in methods.values()}
    if family == "FQI" and len(set(lengths.values())) > 1:
        text = f"{env}: iterations differ between methods ({compared(lengths)})"
        add(text, f"iterations differ: {compared(lengths)}")
    optima = {v.name: v.optimum for v in methods.values()}
    if len({o for o in optima.values() if o is not None}) > 1:
        text = f"{env}: optima differ between methods ({compared(optima)})"
        add(text, "optima differ: none drawn")
    return notes
