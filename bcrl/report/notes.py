"""What is odd about the runs, by name: for the terminal and under the figures."""

from collections.abc import Iterable

from bcrl.report.variants import COMPARED, Methods, Note, Runs
from bcrl.results.layout import spelled


def listed(items: Iterable[object]) -> str:
    """`a, b and c`."""
    *head, last = map(str, items)
    return f"{', '.join(head)} and {last}" if head else last


def tags_shown(methods: Methods) -> str:
    """`variants @released`, or whose: `@released: BC-DQN, SC-DQN`."""
    tags = {v.tag for v in methods.values()}
    (tag,) = tags - {None} or {None}
    if tag is None or len(tags) == 1:
        return f"variants @{tag}" if tag else ""
    return f"@{tag}: {', '.join(n for n, v in methods.items() if v.tag == tag)}"


def remarks(runs: Runs, methods: Methods, compares: bool = True) -> list[str]:
    """The lines that belong under a figure of `methods`, which may be of several tags.
    `compares`: differences between methods belong to it too."""
    env, family = next((v.env, v.family) for v in methods.values())
    tags = {v.tag for v in methods.values()}

    def belongs(note: Note) -> bool:
        if note.method in methods and methods[note.method].tag == note.tag:
            return True
        if note.method:  # it isn't drawn: perhaps it has no complete seed
            awaited = note.method in COMPARED.get((env, family), ())
            return compares and note.incomplete and awaited and note.tag in tags
        return compares and note.family == family and {note.tag} == tags

    shown = [note for note in runs.notes if note.env == env and belongs(note)]
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
    """Notes on compared methods that are absent or that differ in seeds or length. In
    the DQN family lengths differ by design and aren't compared."""
    variants, suffix = methods.values(), f"@{tag}" if tag else ""
    absent = [f"{name}{suffix}" for name in expected if name not in methods]
    found = [f"no runs of {listed(absent)}"] if absent else []
    compared = {"seeds": [spelled(v.seeds) for v in variants]}
    compared |= {"optima": [v.optimum for v in variants]}
    if family == "FQI":
        compared["iterations"] = [len(v.stage) for v in variants]
    for what, values in compared.items():
        groups: dict[object, list[str]] = {}
        for variant, value in zip(variants, values, strict=True):
            groups.setdefault(value, []).append(variant.name)
        if len(groups.keys() - {None}) > 1:
            texts = [f"{value}: {listed(names)}" for value, names in groups.items()]
            found.append(f"{what} differ: {'; '.join(texts)}")
    return [Note(f"{env}: {text}", env, tag, text, family=family) for text in found]
