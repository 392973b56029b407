"""What is read: a variant's seeds as arrays, and one scale's variants."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bcrl.common.files import seed_path
from bcrl.report.notes import Note
from bcrl.report.seedfiles import read_arrays

#: The methods of each family, in the order of the legends.
METHODS = ("FQI", "C-FQI", "B-FQI", "BC-FQI")
DQN_METHODS = (
    *("DQN", "C-DQN", "B-DQN", "BC-DQN", "S-DQN", "SC-DQN", "SB-DQN", "SBC-DQN"),
    *("RPL", "PPR"),
)
FAMILIES = {"FQI": METHODS, "DQN": DQN_METHODS}


@dataclass(frozen=True)
class Variant:
    """All complete seeds of one variant: S seeds, I rows (evaluations) common to them.

    `stage` and `task` have shape (I,), 1-based; `index` (I,) counts the iterations or,
    in the DQN family, the environment steps of all stages so far; every array in
    `metrics` is (S, I); `sidecars` are the seeds' JSON documents, in the order of
    `seeds`; `failed` are the seeds that diverged and are left out.
    """

    env: str
    method: str
    tag: str | None
    family: str
    folder: Path
    seeds: tuple[int, ...]
    stage: NDArray[np.int64]
    task: NDArray[np.int64]
    index: NDArray[np.int64]
    metrics: dict[str, NDArray[np.float64]]
    sidecars: tuple[dict[str, Any], ...]
    failed: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        """The folder's name, `BC-FQI` or `BC-FQI@released`."""
        return self.folder.name

    @property
    def optimum(self) -> float | None:
        """V*(s0) of the target task, None where it is unknown or not one number."""
        values = {sidecar.get("optimum") for sidecar in self.sidecars}
        (value,) = values if len(values) == 1 else (None,)
        return None if value is None else float(value)

    def total(self, fact: str) -> float:
        """The sum over seeds of a number in their JSON documents."""
        return sum(float(sidecar.get(fact) or 0.0) for sidecar in self.sidecars)

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
        self, env: str, tag: str | None, family: str = "FQI", fall_back: bool = False
    ) -> dict[str, Variant]:
        """A family's methods that are there for `env`, in the legends' order.

        `fall_back`: a method without a run of that tag is represented by its untagged
        one, provided that some method has the tag.
        """
        found = self.tagged(env, family, tag)
        if fall_back and found:
            found = self.tagged(env, family, None) | found
        return {name: found[name] for name in FAMILIES[family] if name in found}
