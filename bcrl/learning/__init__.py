"""The paper's algorithms. Read bellman, transfer, stage, fqi, dqn, in this order."""

import numpy as np
from numpy.typing import NDArray

from bcrl.envs.base import Floats as Floats

Integers = NDArray[np.intp]
Booleans = NDArray[np.bool_]
