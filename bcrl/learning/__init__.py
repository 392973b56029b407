"""The paper's algorithms. Read bellman, transfer, stage, fqi, dqn, in this order."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]
Booleans = NDArray[np.bool_]
