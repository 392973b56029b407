"""Compiled extra-trees: rows going down a grown forest."""

from __future__ import annotations

import numpy as np
from numba import njit

from bcrl.q.forest.kernel import ZERO, U, bare, key_of
from bcrl.q.forest.rows import add_value, move_queries, new_rows, plane

#: Rows from which moving them down a tree together beats walking one by one.
TOGETHER = 1000


@bare
def send_down(keys, words, row, d, nodes, values, root, stack, total):
    """Add one tree's predictions to `total`, moving all rows down together."""
    node, depth, top = root, 0, 0
    size = U(total.size)
    start, stop = ZERO, size
    while True:
        child = nodes[node].child
        if nodes[node].feature < 0:
            here = plane(depth) * size
            add_value(row, here + start, here + stop, values[child], total)
        else:
            cut, feature = nodes[node].cut, nodes[node].feature
            middle = move_queries(
                keys, words, row, size, d, depth, start, stop, feature, cut
            )
            depth += 1
            if middle < stop:
                stack[top, 0], stack[top, 1] = child + 1, depth
                stack[top, 2], stack[top, 3] = middle, stop
                top += 1
            if start < middle:
                node, stop = np.int64(child), middle
                continue
        if top == 0:
            return
        top -= 1
        node, depth = stack[top, 0], stack[top, 1]
        start, stop = U(stack[top, 2]), U(stack[top, 3])


@bare
def walk_down(keys, nodes, values, root, at, who, total):
    """Add one tree's predictions to `total`, all rows taking one level a turn.

    Rows that walk side by side wait for memory at the same time, not one after another.
    """
    left = total.size
    for i in range(left):
        at[i], who[i] = root, i
    while left > 0:
        kept = 0
        for j in range(left):
            i, node = who[j], at[j]
            feature = nodes[node].feature
            if feature < 0:
                total[i] += values[nodes[node].child]
            else:
                right = keys[i, feature] > nodes[node].cut
                at[kept], who[kept] = np.int64(nodes[node].child) + right, i
                kept += 1
        left = kept


@njit
def predict_forest(nodes, values, first, x):
    """Mean over the trees at `x` (m, d) float32, as float64 (m,)."""
    trees = first.size - 1
    total, d = np.zeros(x.shape[0]), U(x.shape[1])
    if x.shape[0] >= TOGETHER:
        keys, words, row, _, _ = new_rows(x, False, False)
        stack = np.empty((x.shape[0] + 1, 4), np.int64)
        for t in range(trees):
            root = first[t]
            send_down(keys, words, row, d, nodes, values, root, stack, total)
    else:
        walking = np.empty(x.shape, np.int32)
        at, who = np.empty((2, x.shape[0]), np.int64)
        for i in range(x.shape[0]):
            for f in range(x.shape[1]):
                walking[i, f] = key_of(x[i, f])
        for t in range(trees):
            walk_down(walking, nodes, values, first[t], at, who, total)
    return total / trees
