"""Bounds on paths of the car on the hill, from a cover of its states by cells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bcrl.envs.car_on_hill import MAX_POSITION, MAX_SPEED, CarOnHill
from bcrl.learning import Booleans, Floats

#: Box margin beyond the corners' images, in cells. A cell's image bends away from its
#: corners' hull by less than a third of a cell: where paths cross p = 0 the flow's
#: gradient jumps by up to |v| = 3 /s, elsewhere the flow is smooth.
MARGIN = 0.5
FAR = 32767  # bound of a cell from which the goal is out of reach
LIMITS = np.array([MAX_POSITION, MAX_SPEED])


class Cover(NamedTuple):
    """Bounds for each cell, arrays of shape (cells, cells), position-major."""

    bound: NDArray[np.int64]  # at least so many steps to the goal; FAR: unreachable
    forever: Booleans  # whether every state in the cell can avoid absorption forever

    def cell(self, state: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Row and column of the cell of, or nearest to, states (..., 2)."""
        index = _index(state, len(self.bound))
        return index[..., 0], index[..., 1]


def _index(state: Floats, cells: int) -> NDArray[np.int64]:
    scaled = np.nan_to_num((state / LIMITS + 1.0) * (cells / 2))
    return np.clip(scaled, 0, cells - 1).astype(np.int64)


def image_boxes(mass: float, cells: int) -> tuple[Floats, Floats]:
    """Lower and upper corners of boxes around each cell's image, (2, cells, cells, 2).

    The leading axis is the action.
    """
    axes = [np.linspace(-limit, limit, cells + 1) for limit in LIMITS]
    corners = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    env, margin = CarOnHill(mass=mass), MARGIN * 2.0 * LIMITS / cells
    low, high = np.empty((2, 2, cells, cells, 2))
    for action in (0, 1):
        image, _, _ = env.step(corners, np.full(corners.shape[:2], action))
        four = image[:-1, :-1], image[1:, :-1], image[:-1, 1:], image[1:, 1:]
        low[action] = np.minimum.reduce(four) - margin
        high[action] = np.maximum.reduce(four) + margin
    return low, high


def _count(marked: Booleans, low: NDArray, high: NDArray) -> NDArray[np.int64]:
    """Marked cells in boxes of cells, from `low` (..., 2) to before `high`."""
    total = np.pad(marked.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    (i, j), (k, m) = np.moveaxis(low, -1, 0), np.moveaxis(high, -1, 0)
    return total[k, m] - total[i, m] - total[k, j] + total[i, j]


def cover(mass: float, cells: int) -> Cover:
    """Bounds for all cells, from boxes that touch the goal or lie in the limits."""
    low, high = image_boxes(mass, cells)
    slow = (high[..., 1] >= -MAX_SPEED) & (low[..., 1] <= MAX_SPEED)
    goal = slow & (high[..., 0] > MAX_POSITION)
    alive = slow & (high[..., 0] >= -MAX_POSITION) & (low[..., 0] <= MAX_POSITION)
    safe = ((low >= -LIMITS) & (high <= LIMITS)).all(-1)
    first, last = _index(low, cells), _index(high, cells) + 1
    # A cell is one step further from the goal than the nearest cell it may reach.
    bound, steps = np.where(goal.any(0), 1, FAR), 1
    while (bound == steps).any():
        reaches = alive & (_count(bound <= steps, first, last) > 0)
        steps += 1
        bound[reaches.any(0) & (bound == FAR)] = steps
    # Drop cells until the box of each one left has an action that stays among them.
    area, forever = (last - first).prod(-1), np.ones((cells, cells), bool)
    while True:
        stays = (safe & (_count(forever, first, last) == area)).any(0) & forever
        if (stays == forever).all():
            return Cover(bound, forever)
        forever = stays
