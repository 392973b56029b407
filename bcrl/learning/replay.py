"""A replay buffer for S seeds: packed transitions, the oldest overwritten first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from bcrl.common.serialization import storable
from bcrl.learning import Floats, Integers


@storable
@dataclass(eq=False)
class Replay:
    """The last `capacity` transitions of each seed, with precomputed targets.

    The target of ϱ(s, a) is fixed + discount · max_a' (ϱ + next_base)(s', a'). All but
    ϱ is computed once, when a transition is stored. `bootstrap` caches the maximum by
    the target network, where `valid`.
    """

    #: (S, capacity, 2 d + A + 3): s, s', next_base, fixed, discount, action
    rows: torch.Tensor
    bootstrap: NDArray[np.float32]  # (S, capacity)
    valid: NDArray[np.bool_]  # (S, capacity)
    d: int
    n_actions: int
    added: int = 0  # transitions of each seed, overwritten ones included

    @classmethod
    def empty(
        cls, n_seeds: int, capacity: int, d: int, n_actions: int, device: str
    ) -> Replay:
        """A replay without transitions."""
        shape = (n_seeds, capacity)
        rows = torch.zeros((*shape, 2 * d + n_actions + 3), device=device)
        bootstrap, valid = np.zeros(shape, np.float32), np.zeros(shape, np.bool_)
        return cls(rows, bootstrap, valid, d, n_actions)

    @property
    def capacity(self) -> int:
        """Transitions of each seed that fit in."""
        return self.rows.shape[1]

    @property
    def size(self) -> int:
        """Transitions of each seed that are stored."""
        return min(self.added, self.capacity)

    def add(
        self,
        state: Floats,  # (S, d)
        next_state: Floats,  # (S, d)
        next_base: Floats,  # (S, A)
        fixed: Floats,  # (S,)
        discount: Floats,  # (S,)
        action: Integers,  # (S,)
    ) -> None:
        """Store one transition of every seed."""
        scalars = (x[:, None] for x in (fixed, discount, action))
        parts = (state, next_state, next_base, *scalars)
        row = np.concatenate(parts, -1, dtype=np.float32, casting="same_kind")
        index = self.added % self.capacity
        if self.rows.is_cpu:  # NumPy's assignment costs a tenth of torch's
            self.rows.numpy()[:, index] = row
        else:
            self.rows[:, index] = torch.from_numpy(row)
        self.valid[:, index] = False
        self.added += 1

    def invalidate(self) -> None:
        """The target network has changed: no cached bootstrap value is valid."""
        self.valid[:] = False

    def indices(self, u: Floats, past: int = 0) -> NDArray[np.int64]:
        """Rows (T, S, B) that uniforms u (T, S, B) draw in T steps, with replacement.

        Step t comes after t + 1 − `past` more transitions have been added.
        """
        held = np.arange(1, len(u) + 1) + self.added - past
        return (u * np.minimum(held, self.capacity)[:, None, None]).astype(np.int64)

    def sample(self, indices: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Transitions at `indices` (S, B), float32: the columns of `rows`.

        Shapes are (S, B, d) twice, (S, B, A), and three times (S, B, 1).
        """
        seed = torch.arange(len(self.rows), device=self.rows.device)[:, None]
        widths = [self.d, self.d, self.n_actions, 1, 1, 1]
        return self.rows[seed, indices].split(widths, -1)
