"""Q-functions: sums of residuals, and the approximators that learn them."""

from bcrl.q.functions import ZERO, Q, Values, each

__all__ = ["ZERO", "Q", "Values", "each"]
