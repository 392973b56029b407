"""Random streams: one per seed and purpose, never a global generator."""

import numpy as np

#: Purposes are numbered for good: a new one is appended, none is renumbered.
PURPOSES = ("data", "exploration", "replay", "weights", "trees", "evaluation")
PURPOSES += ("shared_data", "agent", "distillation", "inspection")


def stream(seed: int, purpose: str, *path: int) -> np.random.Generator:
    """A generator that depends on `(seed, purpose, *path)` alone.

    `path` numbers what the stream is for (stage, iteration, action, …), so that a draw
    never depends on how many draws came before it elsewhere, nor on other seeds.
    """
    key = (PURPOSES.index(purpose), *path)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
