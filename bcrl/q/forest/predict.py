"""Compiled extra-trees: moving rows down a grown forest."""

from __future__ import annotations

import numpy as np

from bcrl.common.compiling import kept
from bcrl.q.forest.buffers import add_value, move_rows, new_rows, plane
from bcrl.q.forest.split import U, key_of, uncounted

#: From so many rows on, it is faster to move them down a tree together.
TOGETHER = 1000


@uncounted
def _move_down(rows, d, nodes, values, root, stack, total):
    """Add one tree's predictions to `total`, moving all rows down together."""
    node, depth, top = root, 0, 0
    n = U(total.size)
    start, stop = U(0), n
    while True:
        child = nodes[node].child
        if nodes[node].feature < 0:
            here = plane(depth) * n
            add_value(rows.origin, here + start, here + stop, values[child], total)
        else:
            cut, feature = nodes[node].cut, nodes[node].feature
            middle = move_rows(rows, n, d, depth, start, stop, feature, cut)
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


@uncounted
def _walk_down(keys, nodes, values, root, at, who, total):
    """Add one tree's predictions to `total`, level by level for all rows.

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


@kept(nogil=True)
def predict_forest(nodes, values, first, x):
    """Mean over the trees at x (m, d) float32, as float64 (m,)."""
    trees, (m, d) = first.size - 1, x.shape
    total = np.zeros(m)
    if m >= TOGETHER:
        rows, stack = new_rows(x, False, False), np.empty((m + 1, 4), np.int64)
        for t in range(trees):
            _move_down(rows, U(d), nodes, values, first[t], stack, total)
    else:
        keys = np.empty(x.shape, np.int32)
        at, who = np.empty((2, m), np.int64)
        for i in range(m):
            for f in range(d):
                keys[i, f] = key_of(x[i, f])
        for t in range(trees):
            _walk_down(keys, nodes, values, first[t], at, who, total)
    return total / trees
