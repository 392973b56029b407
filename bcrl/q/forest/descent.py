"""Compiled prediction: rows go down the trees of a grown forest.

Many rows are sorted down a tree together; few rows walk down side by side, a level at a
time, so that the processor overlaps their reads. Neither way branches on a row's side,
and both add a row's values in the order of the trees: they give the same bytes.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from bcrl.common.compiling import kept
from bcrl.q.forest.split import U, inlined, key_of, uncounted

#: So many rows, and one more for SHARE nodes of a tree, are sorted faster than walked.
TOGETHER, SHARE = 32, 50
SIDE_BY_SIDE = U(16)  # rows that walk down a tree together
CACHED = 2**19  # keys of the rows that are sorted together: 2 MiB


class Descent(NamedTuple):
    """The rows (m, d) that go down, and memory for their way."""

    keys: NDArray[np.int32]  # (m · d,)
    d: int
    one: NDArray[np.uint32]  # (m,) each: the rows, sorted from one into the other
    other: NDArray[np.uint32]  # and back; or the nodes that rows have walked to
    stack: NDArray[np.int64]


@njit
def new_descent(x):
    """The descent of x (m, d) float32."""
    m, d = x.shape
    keys = np.empty(m * d, np.int32)
    for i in range(m):
        for f in range(d):
            keys[i * d + f] = key_of(x[i, f])
    one, other = np.empty(m, np.uint32), np.empty(m, np.uint32)
    stack = np.empty((m + 1, 4), np.int64)  # memory that is not used is free
    return Descent(keys, d, one, other, stack)


@inlined
def planes(descent, depth):
    """The plane that a node of this depth has its rows in, and its children's."""
    if depth & 1:
        return descent.other, descent.one
    return descent.one, descent.other


@inlined
def sort_node(descent, depth, start, stop, feature, cut):
    """Sort a node's rows into its children's plane; returns the left child's end."""
    keys, width, column = descent.keys, U(descent.d), U(feature)
    here, there = planes(descent, depth)
    left, right = start, stop - U(1)
    for i in range(start, stop):
        row = here[i]
        goes_left = U(keys[U(row) * width + column] <= cut)
        there[left], there[right] = row, row  # the next row corrects one
        left += goes_left
        right -= U(1) - goes_left
    return left


@uncounted
def _sort_down(nodes, values, root, descent, begin, end, total):
    """Add one tree's predictions to `total`, sorting the rows begin:end down it."""
    stack, node, depth, top = descent.stack, root, 0, 0
    start, stop = U(begin), U(end)
    for i in range(start, stop):
        descent.one[i] = np.uint32(i)
    while True:
        child, feature, cut = nodes[node].child, nodes[node].feature, nodes[node].cut
        if feature < 0:
            here, _ = planes(descent, depth)
            for i in range(start, stop):
                total[here[i]] += values[child]
        else:
            left = sort_node(descent, depth, start, stop, feature, cut)
            depth += 1
            if left < stop:
                stack[top, 0], stack[top, 1] = child + 1, depth
                stack[top, 2], stack[top, 3] = left, stop
                top += 1
            if start < left:
                node, stop = np.int64(child), left
                continue
        if top == 0:
            return
        top -= 1
        node, depth = stack[top, 0], stack[top, 1]
        start, stop = U(stack[top, 2]), U(stack[top, 3])


@uncounted
def _walk_down(nodes, values, root, descent, total):
    """Add one tree's predictions to `total`, a few rows at a time, level by level."""
    keys, width, at, m = descent.keys, U(descent.d), descent.one, U(total.size)
    for begin in range(U(0), m, SIDE_BY_SIDE):
        end = min(m, begin + SIDE_BY_SIDE)
        for i in range(begin, end):
            at[i] = np.uint32(root)
        walking = True
        while walking:
            walking = False
            for i in range(begin, end):
                node = nodes[U(at[i])]
                inner = node.feature >= 0
                right = keys[i * width + U(max(node.feature, 0))] > node.cut
                at[i] = np.uint32(node.child + right) if inner else at[i]
                walking |= inner
        for i in range(begin, end):
            total[i] += values[nodes[U(at[i])].child]


@njit
def add_trees(nodes, values, first, start, stop, descent, total):
    """Add the predictions of trees start:stop to `total` (m,), in their order."""
    m, size = total.size, (first[stop] - first[start]) // (stop - start)
    if m >= TOGETHER + size // SHARE:
        part = max(1, CACHED // descent.d)
        for begin in range(0, m, part):
            for t in range(start, stop):
                end = min(m, begin + part)
                _sort_down(nodes, values, first[t], descent, begin, end, total)
    else:
        for t in range(start, stop):
            _walk_down(nodes, values, first[t], descent, total)


@kept(nogil=True)
def predict_forest(nodes, values, first, x):
    """Mean over the trees at x (m, d) float32, as float64 (m,)."""
    trees, total = first.size - 1, np.zeros(x.shape[0])
    add_trees(nodes, values, first, 0, trees, new_descent(x), total)
    return total / trees


@kept(nogil=True)
def predict_stack(nodes, values, first, trees, x, begins):
    """Means over trees[k]:trees[k+1] at the rows begins[k]:begins[k+1] of x (m, d)."""
    total = np.zeros(x.shape[0])
    for k in range(trees.size - 1):
        rows, start, stop = x[begins[k] : begins[k + 1]], trees[k], trees[k + 1]
        own = total[begins[k] : begins[k + 1]]
        add_trees(nodes, values, first, start, stop, new_descent(rows), own)
        own /= stop - start
    return total
