"""Boosted Curriculum Reinforcement Learning (Klink et al., ICLR 2022), reproduced."""

__version__ = "0.1.0"

import bcrl.gym  # noqa: F401  registers our environments with Gymnasium
