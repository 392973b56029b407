"""What is reported on: a variant's seeds as arrays, and the variants of a scale."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bcrl.results.layout import seed_path
from bcrl.results.read import read_arrays

LINEAR = "linear_system"
WINDOW = 5000  # environment steps before a run's end whose evaluations are averaged
#: The methods of each family, in the order of the legends.
METHODS = ("FQI", "C-FQI", "B-FQI", "BC-FQI")
DQN_METHODS = (
    *("DQN", "C-DQN", "B-DQN", "BC-DQN", "S-DQN", "SC-DQN", "SB-DQN", "SBC-DQN"),
    *("RPL", "PPR"),
)
FAMILIES = {"FQI": METHODS, "DQN": DQN_METHODS}
#: The methods that the paper's figures compare: what is absent of them gets a note.
COMPARED = {
    ("car_on_hill", "FQI"): METHODS,
    ("maze", "FQI"): METHODS,
    (LINEAR, "DQN"): ("DQN", "C-DQN", "BC-DQN", "SC-DQN", "SBC-DQN", "RPL", "PPR"),
}
_TITLES = {"car_on_hill": "Car on the hill"}

Methods = Mapping[str, "Variant"]  # by the name of the method


@dataclass(frozen=True)
class Note:
    """One diagnostic: `text` for the terminal, `footer` (if any) for the figures.

    It concerns figures of `env` with variants tagged `tag`: those that draw `method`
    or, without a method, compare those of `family`. `incomplete`: it counts seeds.
    """

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

    `stage` and `task` (I,) are 1-based; `index` (I,) counts the iterations or, in the
    DQN family, the environment steps of all stages so far; `metrics` are (S, I);
    `sidecars` are the seeds' JSONs; `failed` are seeds that diverged and are left out.
    The folder's `name` is the `method` and perhaps its `tag`: `BC-FQI@released`.
    """

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
        """Rows that were measured in the target, which is the last task, (T,)."""
        return np.flatnonzero(self.task == self.task[-1])

    def last(self, metric: str) -> np.ndarray:
        """A metric at the last evaluation, (S,)."""
        return self.metrics[metric][:, -1]

    def late(self, metric: str) -> np.ndarray:
        """Every seed's mean over the target's evaluations in the last WINDOW steps."""
        rows = self.target_rows
        rows = rows[self.index[rows] > self.index[-1] - WINDOW]
        return self.metrics[metric][:, rows].mean(axis=1)

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
    def pairs(self) -> list[tuple[str, str]]:
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
        """The known methods of a tag. In the DQN family an untagged one stands in for
        a method that has no run of a tag which others have."""
        found = self.tagged(env, family, tag)
        if found and family == "DQN":
            found = self.tagged(env, family, None) | found
        return {name: found[name] for name in FAMILIES[family] if name in found}

    def compared(self, env: str, tag: str | None, family: str) -> Methods:
        """Those of them that the paper's figures compare; in other environments all."""
        if (env, family) not in COMPARED:
            return self.tagged(env, family, tag)
        found = self.methods(env, tag, family)
        return {n: v for n, v in found.items() if n in COMPARED[env, family]}


def env_title(env: str) -> str:
    """An environment's name as a title, `Mountain car`."""
    return _TITLES.get(env, env.replace("_", " ").capitalize())
