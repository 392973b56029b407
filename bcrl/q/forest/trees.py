"""Compiled extra-trees: growing a forest.

Buffers keep the rows of a node side by side. They hold three *planes*: the rows as
given, and two that the levels of a tree use in turn. A split moves a node's rows from
one plane into the next, without a branch, and reads memory in sequence.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bcrl.common.compiling import compiled, kept
from bcrl.q.forest.descent import new_descent, plane, sort_node
from bcrl.q.forest.groups import GROUP, SHUFFLE, sift
from bcrl.q.forest.lanes import LANES, choose_all, new_sums, store, vector_at
from bcrl.q.forest.split import (
    NODE,
    U,
    choose,
    choose_two,
    inlined,
    is_pure,
    key_of,
    uncounted,
)


class Rows(NamedTuple):
    """The buffers of n rows of d features; `room` is 3 n + GROUP."""

    keys: NDArray[np.int32]  # (width · room,): those of a row are neighbours
    words: NDArray[np.int64]  # the same memory: with width 2, a word is a row
    origin: NDArray[np.uint32]  # (room,): the index that the row was given under
    target: NDArray[np.int64]  # (room,)
    weight: NDArray[np.int64]  # (room,) multiplicities, or empty if all are 1


@compiled()
def _width(d):
    """The keys of a row in memory: 2, or d > 2 rounded up to whole vectors.

    One feature has a constant one beside it, which is never chosen.
    """
    return U(2) if d <= 2 else U((d + LANES - 1) // LANES * LANES)


@compiled()
def _new_rows(x, weighted):
    """Rows whose first plane holds x (n, d) float32; targets and weights are unset."""
    n, width = U(x.shape[0]), _width(x.shape[1])
    room = U(3) * n + U(GROUP)
    keys = np.empty(width * room, np.int32)
    origin = np.empty(room, np.uint32)
    for i in range(n):
        origin[i] = i
        for f in range(width):
            keys[i * width + f] = key_of(x[i, f]) if f < U(x.shape[1]) else 0
    target = np.empty(room, np.int64)
    weight = np.empty(room if weighted else U(0), np.int64)
    return Rows(keys, keys.view(np.int64), origin, target, weight)


@inlined
def _move_rows(rows, n, width, depth, start, stop, feature, cut):
    """Move a node's rows to its children's plane; returns the left child's end."""
    keys, words, origin, target, weight = rows
    a, b = plane(depth) * n, plane(depth + 1) * n
    left, right = start, stop - U(1)
    if SHUFFLE and width == U(2):
        source, to = a + start, b + start
        if weight.size > 0:
            columns = words, origin, target, weight
            return sift(columns, source, a + stop, to, feature, cut) - b
        return sift((words, origin, target), source, a + stop, to, feature, cut) - b
    if width == U(2):
        shift = np.int64(32) * feature
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
            source = (a + i) * width
            goes_left = U(keys[source + U(feature)] <= cut)
            to = left + ((right - i) & (goes_left - U(1)))  # a choice became a branch
            there, more = (b + to) * width, U(LANES)
            store(keys, there, vector_at(keys, source))
            while more < width:
                store(keys, there + more, vector_at(keys, source + more))
                more += U(LANES)
            origin[b + to], target[b + to] = origin[a + i], target[a + i]
            if weight.size > 0:
                weight[b + to] = weight[a + i]
            left += goes_left
    return left


@uncounted
def _grow_tree(
    rows, queries, width, whole, settings, state, work, fitted, queried, tree, at, keep
):
    """Grow one tree depth first and add its predictions to `fitted` and `queried`.

    whole: weight of all rows, their sum of targets, and the target of fixed-point 1;
    work: a permutation of the features, sums and a stack; tree: nodes and values,
    filled from `at` on if `keep`. Returns the new `at` and the tree's depth.
    """
    min_split, min_leaf, max_features, max_depth = settings
    node_weight, node_total, unit = whole
    order, sums, stack = work
    for f in range(order.size):  # a tree depends on its seed alone
        order[f] = f
    nodes, values = tree
    n_nodes, n_values = at
    node, depth, deepest, top = n_nodes, 0, 0, 0
    n_nodes += 1
    n, m = U(fitted.size), U(queried.size)
    start, stop, q_start, q_stop = U(0), n, U(0), m
    while True:
        here = plane(depth) * n
        first, last = here + start, here + stop
        feature, cut, w_left, s_left = -1, np.int32(0), np.int64(0), np.int64(0)
        enough = node_weight >= min_split and node_weight >= 2 * min_leaf
        may_split = enough and depth < max_depth
        if may_split and not is_pure(rows, first, last, node_weight, unit):
            if max_features < order.size:
                limits = min_leaf, max_features
                split, state = choose(
                    rows,
                    width,
                    first,
                    last,
                    node_weight,
                    node_total,
                    limits,
                    state,
                    order,
                )
            elif width == U(2):
                split, state = choose_two(
                    rows, first, last, node_weight, node_total, min_leaf, state
                )
            else:
                split, state = choose_all(
                    rows,
                    first,
                    last,
                    node_weight,
                    node_total,
                    min_leaf,
                    state,
                    order,
                    sums,
                )
            feature, cut, w_left, s_left = split
        if feature < 0:
            value = node_total * unit / node_weight
            for i in range(first, last):
                fitted[rows.origin[i]] += value
            there = plane(depth) * m
            for i in range(there + q_start, there + q_stop):
                queried[U(queries.rows[i]) >> queries.shift] += value
            if keep:
                nodes[node].cut, nodes[node].feature = 0, -1
                nodes[node].child = n_values
                values[n_values] = value
            n_values += 1
            deepest = max(deepest, depth)
            if top == 0:
                return (n_nodes, n_values), deepest
            top -= 1
            node, depth = stack[top, 0], stack[top, 1]
            start, stop = U(stack[top, 2]), U(stack[top, 3])
            q_start, q_stop = U(stack[top, 4]), U(stack[top, 5])
            node_weight, node_total = stack[top, 6], stack[top, 7]
            continue
        middle = _move_rows(rows, n, width, depth, start, stop, feature, cut)
        q_middle = q_start
        if q_start < q_stop:
            q_middle = sort_node(queries, m, depth, q_start, q_stop, feature, cut)
        if keep:
            nodes[node].cut, nodes[node].feature = cut, feature
            nodes[node].child = n_nodes
        node = n_nodes
        n_nodes += 2
        depth += 1
        # The right child waits, the left one is next.
        stack[top, 0], stack[top, 1] = node + 1, depth
        stack[top, 2], stack[top, 3] = middle, stop
        stack[top, 4], stack[top, 5] = q_middle, q_stop
        stack[top, 6], stack[top, 7] = node_weight - w_left, node_total - s_left
        top += 1
        stop, q_stop, node_weight, node_total = middle, q_middle, w_left, s_left


@kept(nogil=True)
def grow_forest(x, y, multiplicity, seeds, queries, settings, keep):
    """Grow one tree per seed and predict at the training and the query rows.

    Data as in `Regression`, but an empty multiplicity if all are 1; settings: the
    fields of `TreeSettings`. Returns nodes, leaf values, first node of each tree
    (T+1,), depths (T,), fitted (n,), queried (m,); no nodes and values unless `keep`.
    """
    weighted, (n, d), trees = multiplicity.size > 0, x.shape, seeds.size
    rows, width = _new_rows(x, weighted), _width(d)
    weight, largest = multiplicity.sum() if weighted else n, np.abs(y).max()
    bits = 0.0
    if largest > 0.0:  # as many as keep every sum of targets below 2^62
        bits = min(62.0 - np.ceil(np.log2(largest) + np.log2(weight)), 1000.0)
    total = np.int64(0)
    if weighted:
        rows.weight[:n] = multiplicity
    for i in range(n):
        rows.target[i] = np.int64(np.rint(y[i] * 2.0**bits))
        total += rows.target[i] * (multiplicity[i] if weighted else 1)
    fitted, queried = np.zeros(n), np.zeros(queries.shape[0])
    work = np.arange(d), new_sums(width), np.empty((n + 1, 8), np.int64)
    descent = new_descent(queries)
    first, depths = np.zeros(trees + 1, np.int64), np.empty(trees, np.int64)
    room = trees * n if keep else 0  # leaves that there can be; unused memory is free
    tree = np.empty(2 * room, NODE), np.empty(room, np.float64)
    whole, leaves = (weight, total, 2.0**-bits), 0
    for t in range(trees):
        buffers = rows, descent, width, whole, settings, seeds[t], work
        at = first[t], leaves
        at, depths[t] = _grow_tree(*buffers, fitted, queried, tree, at, keep)
        first[t + 1], leaves = at
    nodes, values = tree[0][: first[trees]].copy(), tree[1][:leaves].copy()
    return nodes, values, first, depths, fitted / trees, queried / trees
