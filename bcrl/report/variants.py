"""What is reported on: variants' seeds as arrays, and what is odd about them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bcrl.common.divergence import diverging
from bcrl.results.layout import seed_path, spelled
from bcrl.results.outcomes import late_rows
from bcrl.results.read import read_arrays
from bcrl.results.tasks import target_of

LINEAR = "linear_system"
#: The methods of each family, in the order of the legends.
METHODS = ("FQI", "C-FQI", "B-FQI", "BC-FQI")
_DQN = "DQN C-DQN B-DQN BC-DQN S-DQN SC-DQN SB-DQN SBC-DQN RPL PPR"
FAMILIES = {"FQI": METHODS, "DQN": tuple(_DQN.split())}
#: The methods that the paper's figures compare: what is absent of them gets a note.
COMPARED = {
    ("car_on_hill", "FQI"): METHODS,
    ("maze", "FQI"): METHODS,
    (LINEAR, "DQN"): ("DQN", "C-DQN", "BC-DQN", "SC-DQN", "SBC-DQN", "RPL", "PPR"),
}
_TITLES = {
    "acrobot": "Acrobot",
    "car_on_hill": "Car on the hill",
    "cart_pole": "Cart pole",
    "linear_system": "Linear system",
    "maze": "Maze",
    "mountain_car": "Mountain car",
}

Methods = Mapping[str, "Variant"]  # by the name of the method
Pair = tuple[str, str]  # environment and family


@dataclass(frozen=True)
class Note:
    """One diagnostic: `text` for the terminal, `footer` (if any) for figures of `env`
    with variants tagged `tag`: those that draw `method` or, without a method, compare
    those of `family`. `incomplete`: it counts seeds."""

    text: str
    env: str
    tag: str | None
    footer: str = ""
    method: str | None = None
    family: str | None = None
    incomplete: bool = False


@dataclass(eq=False)
class Variant:
    """All complete seeds of one variant: S seeds, I rows (evaluations) common to them.
    `stage`, `task` (I,) and the number of the `target` are 1-based; `index` (I,) counts
    the iterations or, in the DQN family, the environment steps of all stages so far;
    `metrics` are (S, I), those that diverge are `far`; `sidecars` are the seeds' JSONs,
    of which the first has the `config`; `failed` are seeds that diverged and are left
    out. The folder's `name` is the `method` and perhaps its `tag`: `FQI@released`."""

    folder: Path
    family: str
    seeds: tuple[int, ...]
    stage: np.ndarray
    task: np.ndarray
    index: np.ndarray
    metrics: dict[str, np.ndarray]
    sidecars: tuple[dict[str, Any], ...]
    failed: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        self.env, self.name = self.folder.parts[-2:]
        self.method, _, tag = self.name.partition("@")
        self.tag = tag or None
        self.far, self.config = diverging(self.metrics), self.sidecars[0]["config"]
        self.target = target_of(self.config, self.task)

    @property
    def optimum(self) -> float | None:
        """V*(s0) of the target task, None where it is unknown or not one number."""
        values = {sidecar.get("optimum") for sidecar in self.sidecars}
        return values.pop() if len(values) == 1 else None

    @property
    def cpu_seconds(self) -> float:
        """CPU time of all seeds."""
        return sum(float(s.get("cpu_seconds") or 0.0) for s in self.sidecars)

    @property
    def target_rows(self) -> np.ndarray:
        """Rows that were measured in the target, (T,)."""
        return np.flatnonzero(self.task == self.target)

    def last(self, metric: str) -> np.ndarray:
        """A metric at the last evaluation, (S,)."""
        return self.metrics[metric][:, -1]

    @property
    def late_rows(self) -> np.ndarray:
        """Rows of the target in its last WINDOW environment steps, (L,)."""
        return late_rows(self.target_rows, self.index)

    def late(self, metric: str) -> np.ndarray:
        """Every seed's mean over the `late_rows`, (S,)."""
        return self.metrics[metric][:, self.late_rows].mean(axis=1)

    def final(self, metric: str) -> np.ndarray:
        """What a run ends with in the target, (S,): the last value or, in the DQN
        family, a mean over the `late_rows` that have one; nan where there is none."""
        rows = self.late_rows if self.family == "DQN" else self.target_rows[-1:]
        values = np.ma.masked_invalid(self.metrics[metric][:, rows])
        return np.asarray(values.mean(axis=1).filled(np.nan))

    def area(self, metric: str) -> np.ndarray:
        """Every seed's mean over all evaluations in the target, (S,)."""
        return self.metrics[metric][:, self.target_rows].mean(axis=1)

    def arrays(self, seed: int, *names: str) -> list[np.ndarray]:
        """The named arrays of a seed's NPZ; BcrlError if it does not hold them."""
        return read_arrays(seed_path(self.folder, seed, "npz"), *names)


@dataclass(frozen=True)
class Runs:
    """One scale's variants and the notes that reading them gave rise to."""

    scale: str
    variants: tuple[Variant, ...]
    notes: list[Note] = field(default_factory=list)

    @property
    def pairs(self) -> list[Pair]:
        """The environments and families that there are runs of."""
        return list(dict.fromkeys((v.env, v.family) for v in self.variants))

    def of(self, env: str, family: str) -> list[Variant]:
        """All variants of these, untagged ones first, in the legends' order."""
        rank = {method: place for place, method in enumerate(FAMILIES[family])}
        ours = [v for v in self.variants if (v.env, v.family) == (env, family)]
        ours.sort(key=lambda v: (rank.get(v.method, len(rank)), v.method))
        return sorted(ours, key=lambda v: v.tag or "")

    def tagged(self, env: str, family: str, tag: str | None) -> dict[str, Variant]:
        """All methods of that tag, also those that FAMILIES doesn't know."""
        return {v.method: v for v in self.of(env, family) if v.tag == tag}

    def methods(self, env: str, tag: str | None, family: str = "FQI") -> Methods:
        """The known methods of a tag. In the DQN family, and beside a line search, an
        untagged one stands in for a method that has no run of a tag which others have.
        """
        found = self.tagged(env, family, tag)
        if found and (family == "DQN" or tag == "line_search"):
            found = self.tagged(env, family, None) | found
        return {name: found[name] for name in FAMILIES[family] if name in found}

    def compared(self, env: str, tag: str | None, family: str) -> Methods:
        """Those of them that the paper's figures compare; in other environments all."""
        if (env, family) not in COMPARED:
            return self.tagged(env, family, tag)
        found = self.methods(env, tag, family)
        return {n: v for n, v in found.items() if n in COMPARED[env, family]}

    def notes_on(self, tag: str | None) -> list[Note]:
        """The notes for a document about the variants `tag` and those that stand in."""
        linear = self.methods(LINEAR, tag, "DQN").values()
        drawn = {(v.env, v.method, v.tag) for v in linear}
        found = ((note, (note.env, note.method, note.tag)) for note in self.notes)
        return [note for note, about in found if note.tag == tag or about in drawn]


def env_title(env: str) -> str:
    """A shipped environment's name as a title, `Mountain car`; others as they are."""
    return _TITLES.get(env, env)


def listed(items: Iterable[object]) -> str:
    """`a, b and c`."""
    *head, last = map(str, items)
    return f"{', '.join(head)} and {last}" if head else last


def tags_shown(methods: Methods) -> str:
    """`variants @released`, or whose: `@released: BC-DQN, SC-DQN`."""
    tagged = {
        name: v.tag
        for name, v in methods.items()
        if v.tag and not name.partition(" ")[0].endswith(f"@{v.tag}")
    }
    if len(set(tagged.values())) > 1:
        return ""
    (tag,) = set(tagged.values()) or {""}
    if len(tagged) in (0, len(methods)):
        return f"variants @{tag}" if tag else ""
    return f"@{tag}: {', '.join(tagged)}"


def remarks(runs: Runs, methods: Methods, compares: bool = True) -> list[str]:
    """The lines that belong under a figure of `methods`, which may be of several tags.
    `compares`: differences between methods belong to it too."""
    family = next(v.family for v in methods.values())
    tags = {v.tag for v in methods.values()}
    drawn = {(v.env, v.method, v.tag) for v in methods.values()}
    envs = list(dict.fromkeys(v.env for v in methods.values()))

    def belongs(note: Note) -> bool:
        if (note.env, note.method, note.tag) in drawn:
            return True
        if note.method:  # it isn't drawn: perhaps it has no complete seed
            awaited = note.method in COMPARED.get((note.env, family), ())
            return compares and note.incomplete and awaited and note.tag in tags
        return compares and note.family == family and {note.tag} == tags

    shown = [note for note in runs.notes if note.env in envs and belongs(note)]
    if len(envs) > 1:
        shown = [replace(n, footer=n.footer and f"{n.env} {n.footer}") for n in shown]
    if compares and not any(note.family for note in shown):  # as of a mixture of tags
        shown += across_methods(methods, methods, listed(envs), None, family)
    odd = "; ".join(n.footer for n in shown if n.footer and not n.incomplete)
    return list(filter(None, [incomplete(shown), odd and f"Note: {odd}"]))


def incomplete(notes: Iterable[Note]) -> str:
    """`INCOMPLETE: BC-FQI 3 of 20 seeds`; empty if nothing is."""
    counts = [note.footer for note in notes if note.incomplete]
    return f"INCOMPLETE: {', '.join(counts)}" if counts else ""


def across_methods(
    methods: Methods, expected: Iterable[str], env: str, tag: str | None, family: str
) -> list[Note]:
    """Notes on compared methods that are absent or that differ in seeds or length. In
    the DQN family lengths differ by design and aren't compared."""
    suffix = f"@{tag}" if tag else ""
    absent = [f"{name}{suffix}" for name in expected if name not in methods]
    found = [f"no runs of {listed(absent)}"] if absent else []
    compared = {"seeds": lambda v: spelled(v.seeds), "optima": lambda v: v.optimum}
    if family == "FQI":
        compared["iterations"] = lambda v: len(v.stage)
    for what, value_of in compared.items():
        groups: dict[object, list[str]] = {}
        for label, variant in methods.items():
            name = label if label.startswith(variant.name) else variant.name
            groups.setdefault(value_of(variant), []).append(name)
        if len(groups.keys() - {None}) > 1:
            texts = [f"{value}: {listed(names)}" for value, names in groups.items()]
            found.append(f"{what} differ: {'; '.join(texts)}")
    return [Note(f"{env}: {text}", env, tag, text, family=family) for text in found]
