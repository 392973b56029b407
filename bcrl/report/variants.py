"""What is reported on: a variant's seeds as arrays, and the variants of a scale."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bcrl.results.layout import seed_path
from bcrl.results.read import read_arrays

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
    ("linear_system", "DQN"): tuple(
        name for name in DQN_METHODS if name not in ("B-DQN", "S-DQN", "SB-DQN")
    ),
}
_TITLES = {"car_on_hill": "Car on the hill"}

Methods = Mapping[str, "Variant"]  # by the name of the method


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

    @classmethod
    def of(cls, folder: Path, text: str, footer: str = "", **more: Any) -> Note:
        """A note on the variant in `folder`."""
        method, _, tag = folder.name.partition("@")
        where = {"env": folder.parent.name, "tag": tag or None, "method": method}
        return cls(f"{folder}: {text}", footer=footer, **where, **more)


@dataclass(frozen=True)
class Variant:
    """All complete seeds of one variant: S seeds, I rows (evaluations) common to them.

    `stage` and `task` have shape (I,), 1-based; `index` (I,) counts the iterations or,
    in the DQN family, the environment steps of all stages so far; every array in
    `metrics` is (S, I); `sidecars` are the seeds' JSON documents, in the order of
    `seeds`; `failed` are the seeds that diverged and are left out.
    """

    folder: Path
    family: str
    seeds: tuple[int, ...]
    stage: NDArray[np.int64]
    task: NDArray[np.int64]
    index: NDArray[np.int64]
    metrics: dict[str, NDArray[np.float64]]
    sidecars: tuple[dict[str, Any], ...]
    failed: tuple[int, ...] = ()

    @property
    def env(self) -> str:
        """The environment's name."""
        return self.folder.parent.name

    @property
    def name(self) -> str:
        """The folder's name, `BC-FQI` or `BC-FQI@released`."""
        return self.folder.name

    @property
    def method(self) -> str:
        """The name without the tag."""
        return self.name.partition("@")[0]

    @property
    def tag(self) -> str | None:
        """What follows the @ in the name."""
        return self.name.partition("@")[2] or None

    @property
    def optimum(self) -> float | None:
        """V*(s0) of the target task, None where it is unknown or not one number."""
        values = {sidecar.get("optimum") for sidecar in self.sidecars}
        (value,) = values if len(values) == 1 else (None,)
        return None if value is None else float(value)

    @property
    def cpu_seconds(self) -> float:
        """CPU time of all seeds."""
        return sum(float(s.get("cpu_seconds") or 0.0) for s in self.sidecars)

    def last(self, metric: str) -> NDArray[np.float64]:
        """A metric at the last evaluation, (S,)."""
        return self.metrics[metric][:, -1]

    def rows(self, stage: int) -> NDArray[np.intp]:
        """The rows of a stage; none if there is no such stage."""
        return np.flatnonzero(self.stage == stage)

    def arrays(self, seed: int, *names: str) -> list[NDArray[np.float64]]:
        """The named arrays of a seed's NPZ; BcrlError if it does not hold them."""
        return read_arrays(self.npz(seed), *names)

    def npz(self, seed: int) -> Path:
        """Where a seed's arrays are."""
        return seed_path(self.folder, seed, "npz")


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
        known = FAMILIES[family]

        def place(variant: Variant) -> tuple[str, int, str]:
            method = variant.method
            rank = known.index(method) if method in known else len(known)
            return variant.tag or "", rank, method

        ours = (v for v in self.variants if (v.env, v.family) == (env, family))
        return sorted(ours, key=place)

    def tagged(self, env: str, family: str, tag: str | None) -> dict[str, Variant]:
        """All methods of that tag, also those that FAMILIES doesn't know."""
        return {v.method: v for v in self.of(env, family) if v.tag == tag}

    def methods(
        self, env: str, tag: str | None, family: str = "FQI"
    ) -> dict[str, Variant]:
        """The known methods of a tag. In the DQN family an untagged one stands in for
        a method that has no run of a tag which others have."""
        found = self.tagged(env, family, tag)
        if found and family == "DQN":
            found = self.tagged(env, family, None) | found
        return {name: found[name] for name in FAMILIES[family] if name in found}

    def compared(self, env: str, tag: str | None, family: str) -> dict[str, Variant]:
        """Those of them that the paper's figures compare; in other environments all."""
        if (env, family) not in COMPARED:
            return self.tagged(env, family, tag)
        found = self.methods(env, tag, family)
        return {n: v for n, v in found.items() if n in COMPARED[env, family]}


def env_title(env: str) -> str:
    """An environment's name as a title, `Mountain car`."""
    return _TITLES.get(env, env.replace("_", " ").capitalize())
