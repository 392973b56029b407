"""Arrays for compiled code, and the normal quantile."""

import numpy as np
from numpy.typing import NDArray


def writable(array: NDArray) -> NDArray[np.float64]:
    """The array as compiled code takes it: float64, contiguous and writable."""
    usual = array.flags.carray and array.dtype == np.float64
    return array if usual else np.array(array, np.float64, order="C")


def ndtri(u: NDArray[np.float64]) -> NDArray[np.float64]:
    """The standard normal quantile of uniforms u in [0, 1); u = 0 counts as 2⁻⁵⁴."""
    from scipy.special import ndtri as quantile

    return quantile(np.maximum(u, 2.0**-54))
