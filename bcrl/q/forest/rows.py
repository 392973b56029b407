"""Compiled buffers that keep the rows of a tree's node side by side.

A buffer holds three **planes**: the rows as given, and two that the levels of a tree
use in turn. A split moves a node's rows from one plane into the next, without a branch
and so that memory is read in sequence: with two features in groups, where the processor
has the instructions (`bcrl.q.forest.lanes`), else row by row, two features as one word.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bcrl.q.forest.kernel import ONE, TWO, ZERO, U, key_of, woven
from bcrl.q.forest.lanes import LANES, SHUFFLE, sift


@njit
def new_rows(x, carries, weighted):
    """Buffers whose first plane holds `x` (size, d); targets and weights to be filled.

    keys: (d·room,) int32, row by row, with room = 3·size + LANES; words: the same
    memory as int64, so that the two keys of a row move as one; row: (room,) uint32, the
    index the row was given under; target: (room,) int64, or empty for query rows;
    weight: (room,) int64 multiplicities, or empty if all are 1.
    """
    size, d = U(x.shape[0]), U(x.shape[1])
    room = U(3) * size + U(LANES)
    keys = np.empty(d * room + (d * room & ONE), np.int32)
    row = np.empty(room, np.uint32)
    for i in range(size):
        row[i] = i
        for f in range(d):
            keys[i * d + f] = key_of(x[i, f])
    target = np.empty(room if carries else ZERO, np.int64)
    weight = np.empty(room if weighted else ZERO, np.int64)
    return keys, keys.view(np.int64), row, target, weight


@woven
def plane(depth):
    """The plane that a node of this depth lies in."""
    return ZERO if depth == 0 else U(1 + (depth & 1))


@woven
def sift_all(columns, a, b, start, stop, feature, cut):
    """`sift` rows `start:stop` from the plane at `a` to that at `b`; left ones' end."""
    left, right = b + start, b + stop - ONE
    rise, end = np.int64(32) * (1 - feature), a + stop
    for i in range(a + start, end, U(LANES)):
        moved = sift(columns, i, end, left, right, rise, cut)
        left += moved
        right -= min(U(LANES), end - i) - moved
    return left - b


@woven
def move_rows(
    keys, words, row, target, weight, size, d, depth, start, stop, feature, cut
):
    """Move a node's rows to its children's plane, left ones first; where these end."""
    a, b = plane(depth) * size, plane(depth + 1) * size
    if SHUFFLE and d == TWO:
        if weight.size > 0:
            columns = (words, row, target, weight)
            return sift_all(columns, a, b, start, stop, feature, cut)
        return sift_all((words, row, target), a, b, start, stop, feature, cut)
    left, right = start, stop - ONE
    if d == TWO:
        shift = np.int64(32) * feature
        for i in range(start, stop):
            word = words[a + i]
            goes = U(np.int32(word >> shift) <= cut)
            p = left if goes else right
            words[b + p] = word
            row[b + p] = row[a + i]
            target[b + p] = target[a + i]
            if weight.size > 0:
                weight[b + p] = weight[a + i]
            left += goes
            right -= ONE - goes
    else:
        for i in range(start, stop):
            goes = U(keys[(a + i) * d + U(feature)] <= cut)
            p = left if goes else right
            for f in range(d):
                keys[(b + p) * d + f] = keys[(a + i) * d + f]
            row[b + p] = row[a + i]
            target[b + p] = target[a + i]
            if weight.size > 0:
                weight[b + p] = weight[a + i]
            left += goes
            right -= ONE - goes
    return left


@woven
def move_queries(keys, words, row, size, d, depth, start, stop, feature, cut):
    """`move_rows` for query rows, which have neither target nor weight."""
    a, b = plane(depth) * size, plane(depth + 1) * size
    if SHUFFLE and d == TWO:
        return sift_all((words, row), a, b, start, stop, feature, cut)
    left, right = start, stop - ONE
    if d == TWO:
        shift = np.int64(32) * feature
        for i in range(start, stop):
            word = words[a + i]
            goes = U(np.int32(word >> shift) <= cut)
            p = left if goes else right
            words[b + p] = word
            row[b + p] = row[a + i]
            left += goes
            right -= ONE - goes
    else:
        for i in range(start, stop):
            goes = U(keys[(a + i) * d + U(feature)] <= cut)
            p = left if goes else right
            for f in range(d):
                keys[(b + p) * d + f] = keys[(a + i) * d + f]
            row[b + p] = row[a + i]
            left += goes
            right -= ONE - goes
    return left


@woven
def add_value(row, start, stop, value, total):
    """Add a leaf's value to `total` at the rows that lie in it."""
    for i in range(start, stop):
        total[row[i]] += value
