"""What a cover of the hill's state space by cells tells about paths through it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bcrl.common.compiling import kept
from bcrl.envs.car_on_hill import MAX_POSITION, MAX_SPEED, CarOnHill

#: Box margin beyond the corners' images, in cells. A cell's image bends away from its
#: corners' hull by less than a third of a cell: where paths cross p = 0 the flow's
#: gradient jumps by up to |v| = 3 /s, elsewhere the flow is smooth.
MARGIN = 0.5
FAR = 32767  # bound of a cell from which the goal is out of reach
LIMITS = np.array([MAX_POSITION, MAX_SPEED])


class Cover(NamedTuple):
    """What is known of each cell, arrays of shape (cells, cells), position-major."""

    bound: NDArray[np.int16]  # steps to the goal, at least; FAR: unreachable
    forever: NDArray[np.bool_]  # whether all its states can avoid absorption for good

    def cell(
        self, state: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Row and column of states (..., 2), outside ones of the nearest cell."""
        index = _index(state, len(self.bound))
        return index[..., 0], index[..., 1]


def image_boxes(
    mass: float, cells: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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


def _index(state: NDArray[np.float64], cells: int) -> NDArray[np.int64]:
    scaled = np.nan_to_num((state / LIMITS + 1.0) * (cells / 2))
    return np.clip(scaled, 0, cells - 1).astype(np.int64)


def cover(mass: float, cells: int) -> Cover:
    """Bounds for every cell, from boxes that meet the goal or lie inside the limits."""
    low, high = image_boxes(mass, cells)
    slow = (high[..., 1] >= -MAX_SPEED) & (low[..., 1] <= MAX_SPEED)
    goal = slow & (high[..., 0] > MAX_POSITION)
    alive = slow & (high[..., 0] >= -MAX_POSITION) & (low[..., 0] <= MAX_POSITION)
    safe = ((low >= -LIMITS) & (high <= LIMITS)).all(-1)
    span = np.stack([_index(low, cells), _index(high, cells)], -2).astype(np.int16)
    bound = np.where(goal.any(0), 1, FAR).astype(np.int16)
    _spread(bound, span, alive)
    forever = np.ones((cells, cells), dtype=np.bool_)
    _erode(forever, span, safe)
    return Cover(bound, forever)


@kept(nogil=True)
def _accumulate(marked: NDArray[np.bool_], total: NDArray[np.int32]) -> None:
    """total[i, j] = marked cells before row i and column j."""
    for i in range(marked.shape[0]):
        row = 0
        for j in range(marked.shape[1]):
            row += marked[i, j]
            total[i + 1, j + 1] = total[i, j + 1] + row


@kept(nogil=True)
def _inside(total: NDArray[np.int32], box: NDArray[np.int16]) -> tuple[int, int]:
    """Marked cells, and all cells, that a box [[i0, j0], [i1, j1]] touches."""
    i0, j0, i1, j1 = box[0, 0], box[0, 1], box[1, 0] + 1, box[1, 1] + 1
    marked = total[i1, j1] - total[i0, j1] - total[i1, j0] + total[i0, j0]
    return marked, (i1 - i0) * (j1 - j0)


@kept(nogil=True)
def _spread(
    bound: NDArray[np.int16], span: NDArray[np.int16], alive: NDArray[np.bool_]
) -> None:
    """Grow `bound` from the goal: a cell is one step above the lowest it may reach."""
    total = np.zeros((bound.shape[0] + 1, bound.shape[1] + 1), np.int32)
    steps, grown = 1, True
    while grown:
        _accumulate(bound <= steps, total)
        grown = False
        steps += 1
        for i in range(bound.shape[0]):
            for j in range(bound.shape[1]):
                for a in range(2):
                    if not alive[a, i, j] or bound[i, j] <= steps:
                        continue
                    if _inside(total, span[a, i, j])[0] > 0:
                        bound[i, j] = steps
                        grown = True


@kept(nogil=True)
def _erode(
    forever: NDArray[np.bool_], span: NDArray[np.int16], safe: NDArray[np.bool_]
) -> None:
    """Drop cells until each one left has an action whose box stays among those left."""
    total = np.zeros((forever.shape[0] + 1, forever.shape[1] + 1), np.int32)
    shrunk = True
    while shrunk:
        _accumulate(forever, total)
        shrunk = False
        for i in range(forever.shape[0]):
            for j in range(forever.shape[1]):
                if forever[i, j]:
                    stays = False
                    for a in range(2):
                        if safe[a, i, j]:
                            marked, touched = _inside(total, span[a, i, j])
                            stays |= marked == touched
                    forever[i, j] = stays
                    shrunk |= not stays
