"""What is odd about the runs, by name: for the terminal and under the figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from bcrl.report.variants import Methods, Note
from bcrl.results.layout import spelled, variant_name


def listed(items: Iterable[object]) -> str:
    """`a, b and c`."""
    *head, last = map(str, items)
    return f"{', '.join(head)} and {last}" if head else last


def _grouped(values: Mapping[str, object]) -> str:
    """`60: FQI and C-FQI; 40: BC-FQI` for a mapping from names to values."""
    groups: dict[object, list[str]] = {}
    for name, value in values.items():
        groups.setdefault(value, []).append(name)
    return "; ".join(f"{value}: {listed(names)}" for value, names in groups.items())


def tags_shown(methods: Methods) -> str:
    """`variants @released`, or whose: `@released: BC-, SC-, SBC-DQN`."""
    tags = {v.tag for v in methods.values()}
    (tag,) = tags - {None} or {None}
    if tag is None or len(tags) == 1:
        return f"variants @{tag}" if tag else ""
    names = [name for name, v in methods.items() if v.tag == tag]
    shared = [name for name in names if name.endswith("-DQN")]
    short = [n.removesuffix("DQN") if n in shared[:-1] else n for n in names]
    return f"@{tag}: {', '.join(short)}"


def remarks(
    notes: Iterable[Note], methods: Methods, compares: bool = True
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
    odd = [note.footer for note in shown if note.footer and not note.incomplete]
    lines = [incomplete(shown), f"Note: {'; '.join(odd)}" if odd else ""]
    return [line for line in lines if line]


def incomplete(notes: Iterable[Note]) -> str:
    """`INCOMPLETE: BC-FQI 3 of 20 seeds`; empty if nothing is."""
    counts = [note.footer for note in notes if note.incomplete]
    return f"INCOMPLETE: {', '.join(counts)}" if counts else ""


def across_methods(
    methods: Methods, expected: Iterable[str], env: str, tag: str | None, family: str
) -> list[Note]:
    """Notes on compared methods that are absent or that differ in seeds or length.

    In the DQN family lengths differ by design and aren't compared.
    """
    variants = methods.values()
    found = []  # for the terminal, for the footer
    absent = [variant_name(name, tag) for name in expected if name not in methods]
    if absent:
        found.append((f"no runs of {listed(absent)}",) * 2)
    seeds = _grouped({v.name: spelled(v.seeds) for v in variants})
    iterations = _grouped({v.name: len(v.stage) for v in variants})
    for what, values in (("seeds", seeds), ("iterations", iterations)):
        if "; " in values and (what == "seeds" or family == "FQI"):
            text = f"{what} differ between methods ({values})"
            found.append((text, f"{what} differ: {values}"))
    if len({v.optimum for v in variants} - {None}) > 1:
        optima = _grouped({v.name: v.optimum for v in variants})
        text = f"optima differ between methods ({optima})"
        found.append((text, "optima differ: none drawn"))
    return [Note(f"{env}: {a}", env, tag, b, family=family) for a, b in found]
