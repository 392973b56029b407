"""A replay buffer for S seeds: packed transitions, the oldest overwritten first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from bcrl.common.compiling import kept
from bcrl.common.serialization import storable


@dataclass(frozen=True)
class Batch:
    """B transitions of each of S seeds, float32 but for the action.

    The regression target of ϱ(s, a) is `fixed + discount · max_a' (ϱ + base)(s', a')`.
    """

    state: torch.Tensor  # (S, B, d)
    next_state: torch.Tensor  # (S, B, d)
    next_base: torch.Tensor  # (S, B, A)
    fixed: torch.Tensor  # (S, B)
    discount: torch.Tensor  # (S, B)
    action: torch.Tensor  # (S, B, 1), int64


@storable
@dataclass(eq=False)
class Replay:
    """The last `capacity` transitions of each seed, and their targets' frozen parts.

    What base and shaping add to a target is fixed when a transition is stored, so it is
    computed once and not for every batch that draws it. `bootstrap` has room for a
    row's max_a' (ϱ + base)(s') by the target network, `known` says which are so: none
    in a new row, and none after `forget`.
    """

    rows: torch.Tensor  # (S, capacity, 2 d + A + 3)
    bootstrap: NDArray[np.float32]  # (S, capacity)
    known: NDArray[np.bool_]  # (S, capacity)
    d: int
    n_actions: int
    added: int = 0

    @classmethod
    def empty(
        cls, n_seeds: int, capacity: int, d: int, n_actions: int, device: str
    ) -> Replay:
        """A replay that nothing was added to."""
        shape = (n_seeds, capacity)
        rows = torch.zeros((*shape, 2 * d + n_actions + 3), device=device)
        bootstrap, known = np.zeros(shape, np.float32), np.zeros(shape, np.bool_)
        return cls(rows, bootstrap, known, d, n_actions)

    def __post_init__(self) -> None:
        n_seeds, self.capacity, width = self.rows.shape
        on_cpu = self.rows.device.type == "cpu"
        self._shared = self.rows.numpy() if on_cpu else None  # the same memory
        self._row = np.empty((n_seeds, 1, width), np.float32)
        first = torch.arange(n_seeds, device=self.rows.device)
        self._first = first[:, None] * self.capacity

    @property
    def size(self) -> int:
        """Transitions held of each seed."""
        return min(self.added, self.capacity)

    def add(
        self,
        state: NDArray[np.float64],
        next_state: NDArray[np.float64],
        next_base: NDArray[np.float64],
        fixed: NDArray[np.float64],
        discount: NDArray[np.float64],
        action: NDArray[np.intp],
    ) -> None:
        """Store one transition of every seed; shapes as in `Batch` without B."""
        at = self.added % self.capacity
        parts = (state, next_state, next_base, fixed, discount, action)
        if self._shared is not None:
            _pack(self._shared, at, *parts)
        else:
            _pack(self._row, 0, *parts)
            self.rows[:, at] = torch.from_numpy(self._row[:, 0])
        self.known[:, at] = False
        self.added += 1

    def forget(self) -> None:
        """The target network has changed: no bootstrap value is known any longer."""
        self.known[:] = False

    def places(self, u: NDArray[np.float64], past: int = 0) -> NDArray[np.int64]:
        """Which of a seed's rows uniforms u (T, S, B) pick in T steps.

        Step t comes after adding t + 1 − `past` more; with replacement.
        """
        held = np.arange(1, len(u) + 1) + self.added - past
        return (u * np.minimum(held, self.capacity)[:, None, None]).astype(np.int64)

    def sample(self, places: torch.Tensor) -> Batch:
        """The transitions at `places` (S, B)."""
        n_seeds, _, width = self.rows.shape
        flat = (places + self._first).flatten()
        rows = self.rows.view(-1, width).index_select(0, flat)
        rows = rows.view(n_seeds, -1, width)
        d, end = self.d, 2 * self.d + self.n_actions
        return Batch(
            rows[..., :d],
            rows[..., d : 2 * d],
            rows[..., 2 * d : end],
            rows[..., end],
            rows[..., end + 1],
            rows[..., end + 2 :].long(),
        )


@kept
def _pack(rows, at, state, next_state, next_base, fixed, discount, action):
    """Row `at` of every seed: state, next state, next base, c, discount, action."""
    d, n_actions = state.shape[1], next_base.shape[1]
    for s in range(len(rows)):
        row = rows[s, at]
        for i in range(d):
            row[i], row[d + i] = state[s, i], next_state[s, i]
        for a in range(n_actions):
            row[2 * d + a] = next_base[s, a]
        end = 2 * d + n_actions
        row[end], row[end + 1], row[end + 2] = fixed[s], discount[s], action[s]
