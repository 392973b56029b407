"""Compiled buffers that keep the rows of a tree's node side by side.

A buffer holds three *planes*: the rows as given, and two that the levels of a tree use
in turn. A split moves a node's rows from one plane into the next. It does so without a
branch and reads memory in sequence. The keys of two features move as one word.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from bcrl.q.forest.split import U, inlined, key_of


class Rows(NamedTuple):
    """The buffers of n rows of d features; `room` is 3 n."""

    keys: NDArray[np.int32]  # (d · room,): the keys of a row are neighbours
    words: NDArray[np.int64]  # the same memory: with d = 2, a word is a row
    origin: NDArray[np.uint32]  # (room,): the index that the row was given under
    target: NDArray[np.int64]  # (room,), or empty for queries
    weight: NDArray[np.int64]  # (room,) multiplicities, or empty if all are 1


@njit
def new_rows(x, has_targets, weighted):
    """Rows whose first plane holds x (n, d) float32; targets and weights are unset."""
    n, d = U(x.shape[0]), U(x.shape[1])
    room = U(3) * n
    keys = np.empty(d * room + (d * room & U(1)), np.int32)
    origin = np.empty(room, np.uint32)
    for i in range(n):
        origin[i] = i
        for f in range(d):
            keys[i * d + f] = key_of(x[i, f])
    target = np.empty(room if has_targets else U(0), np.int64)
    weight = np.empty(room if weighted else U(0), np.int64)
    return Rows(keys, keys.view(np.int64), origin, target, weight)


@inlined
def plane(depth):
    """The plane that a node of this depth lies in."""
    return U(0) if depth == 0 else U(1 + (depth & 1))


@inlined
def move_rows(rows, n, d, depth, start, stop, feature, cut):
    """Move the rows start:stop of a node to its children's plane, left ones first.

    Returns the end of the left child's rows.
    """
    keys, words, origin, target, weight = rows
    a, b = plane(depth) * n, plane(depth + 1) * n
    left, right = start, stop - U(1)
    shift = np.int64(32) * feature
    if d == U(2) and target.size == 0:
        for i in range(start, stop):
            word = words[a + i]
            goes_left = U(np.int32(word >> shift) <= cut)
            to = left if goes_left else right
            words[b + to], origin[b + to] = word, origin[a + i]
            left += goes_left
            right -= U(1) - goes_left
    elif d == U(2):
        for i in range(start, stop):
            word = words[a + i]
            goes_left = U(np.int32(word >> shift) <= cut)
            to = left if goes_left else right
            words[b + to], origin[b + to] = word, origin[a + i]
            target[b + to] = target[a + i]
            if weight.size > 0:
                weight[b + to] = weight[a + i]
            left += goes_left
            right -= U(1) - goes_left
    else:
        for i in range(start, stop):
            goes_left = U(keys[(a + i) * d + U(feature)] <= cut)
            to = left if goes_left else right
            for f in range(d):
                keys[(b + to) * d + f] = keys[(a + i) * d + f]
            origin[b + to] = origin[a + i]
            if target.size > 0:
                target[b + to] = target[a + i]
            if weight.size > 0:
                weight[b + to] = weight[a + i]
            left += goes_left
            right -= U(1) - goes_left
    return left


@inlined
def add_value(origin, start, stop, value, total):
    """Add a leaf's value to `total` at the rows start:stop that lie in it."""
    for i in range(start, stop):
        total[origin[i]] += value
