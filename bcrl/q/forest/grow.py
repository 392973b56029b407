"""Compiled extra-trees: growing a forest while query rows move down with it."""

from __future__ import annotations

import numpy as np
from numba import njit

from bcrl.common.compiling import kept
from bcrl.q.forest.buffers import add_value, move_rows, new_rows, plane
from bcrl.q.forest.split import (
    NODE,
    U,
    choose,
    choose_two,
    is_pure,
    uncounted,
)


@uncounted
def _grow_tree(
    rows, queries, d, whole, settings, state, work, fitted, queried, tree, at, keep
):
    """Grow one tree depth first and add its predictions to `fitted` and `queried`.

    rows, queries: `Rows`; whole: weight of all rows, their sum of targets, and the
    target of fixed-point 1; settings: as in `grow_forest`; work: a permutation of the
    features and a stack; tree: nodes and values, filled from `at` on if `keep`. Returns
    the new `at` and the tree's depth.
    """
    min_split, min_leaf, max_features, max_depth = settings
    node_weight, node_total, unit = whole
    order, stack = work
    nodes, values = tree
    n_nodes, n_values = at
    node, depth, deepest, top = n_nodes, 0, 0, 0
    n_nodes += 1
    n, n_queries = U(fitted.size), U(queried.size)
    start, stop, q_start, q_stop = U(0), n, U(0), n_queries
    both = d == U(2) and max_features >= 2
    while True:
        here = plane(depth) * n
        first, last = here + start, here + stop
        feature, cut, w_left, s_left = -1, np.int32(0), np.int64(0), np.int64(0)
        if (
            node_weight >= min_split
            and depth < max_depth
            and node_weight >= 2 * min_leaf
            and not is_pure(rows.target, rows.weight, first, last, node_weight, unit)
        ):
            if both:
                split, state = choose_two(
                    rows, first, last, node_weight, node_total, min_leaf, state
                )
            else:
                limits = min_leaf, max_features
                split, state = choose(
                    rows, first, last, node_weight, node_total, limits, state, order
                )
            feature, cut, w_left, s_left = split
        if feature < 0:
            value = node_total * unit / node_weight
            add_value(rows.origin, first, last, value, fitted)
            q_here = plane(depth) * n_queries
            add_value(queries.origin, q_here + q_start, q_here + q_stop, value, queried)
            if keep:
                nodes[node].cut = 0
                nodes[node].feature = -1
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
        middle = move_rows(rows, n, d, depth, start, stop, feature, cut)
        q_middle = q_start
        if q_start < q_stop:
            q_middle = move_rows(
                queries, n_queries, d, depth, q_start, q_stop, feature, cut
            )
        if keep:
            nodes[node].cut = cut
            nodes[node].feature = feature
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


@njit
def _enlarged(array, size):
    """A copy of `array` with room for `size` elements."""
    larger = np.empty(size, array.dtype)
    larger[: array.size] = array
    return larger


@kept(nogil=True)
def grow_forest(x, y, multiplicity, seeds, queries, settings, keep):
    """Grow one tree per seed and predict at the training and the query rows.

    x: (n, d) float32; y: (n,) float64; multiplicity: (n,) int64, or empty if all are 1;
    seeds: (T,) uint64; queries: (m, d) float32; settings: min_samples_split,
    min_samples_leaf, max_features, max_depth.
    Returns nodes, leaf values, first node of each tree (T+1,), depths (T,), fitted
    (n,), queried (m,); nodes and values are empty unless `keep`.
    """
    weighted = multiplicity.size > 0
    rows, query_rows = new_rows(x, True, weighted), new_rows(queries, False, False)
    weight, largest = np.int64(0), 0.0
    for i in range(y.size):
        weight += multiplicity[i] if weighted else 1
        largest = max(largest, abs(y[i]))
    bits = 0.0
    if largest > 0.0:  # as many as keep every sum of targets below 2^62
        bits = min(62.0 - np.ceil(np.log2(largest) + np.log2(weight)), 1000.0)
    total = np.int64(0)
    for i in range(y.size):
        rows.target[i] = np.int64(np.rint(y[i] * 2.0**bits))
        if weighted:
            rows.weight[i] = multiplicity[i]
        total += rows.target[i] * (multiplicity[i] if weighted else 1)
    fitted, queried = np.zeros(x.shape[0]), np.zeros(queries.shape[0])
    work = np.arange(x.shape[1]), np.empty((x.shape[0] + 1, 8), np.int64)
    trees = seeds.size
    first, depths = np.zeros(trees + 1, np.int64), np.empty(trees, np.int64)
    most = x.shape[0]  # leaves that a tree can have
    nodes = np.empty(2 * most if keep else 0, NODE)
    values = np.empty(most if keep else 0, np.float64)
    whole, d, leaves = (weight, total, 2.0**-bits), U(x.shape[1]), 0
    for t in range(trees):
        if keep and leaves + most > values.size:
            room = leaves + most + (trees - t) * leaves // t
            nodes, values = _enlarged(nodes, 2 * room), _enlarged(values, room)
        at, tree = (first[t], leaves), (nodes, values)
        buffers = rows, query_rows, d, whole, settings, seeds[t], work
        at, depths[t] = _grow_tree(*buffers, fitted, queried, tree, at, keep)
        first[t + 1], leaves = at
    if keep:
        nodes, values = nodes[: first[trees]].copy(), values[:leaves].copy()
    return nodes, values, first, depths, fitted / trees, queried / trees
