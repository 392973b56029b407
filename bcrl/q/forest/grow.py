"""Compiled extra-trees: growing a forest, query rows going down with it."""

from __future__ import annotations

import numpy as np
from numba import njit

from bcrl.q.forest.kernel import NODE, TWO, ZERO, U, bare, choose, choose_two, is_pure
from bcrl.q.forest.rows import add_value, move_queries, move_rows, new_rows, plane


@bare
def grow_tree(
    keys,
    words,
    row,
    target,
    weight,
    q_keys,
    q_words,
    q_row,
    d,
    w_node,
    s_node,
    unit,
    settings,
    state,
    order,
    stack,
    fitted,
    queried,
    nodes,
    n_nodes,
    values,
    n_values,
    keep,
):
    """Grow one tree depth first and add its predictions to `fitted` and `queried`.

    keys … weight, q_keys … q_row: buffers of `new_rows`; w_node, s_node: weight and sum
    of targets of all rows; unit: target of fixed-point 1; settings: as in
    `grow_forest`; nodes, values: where to put the tree if `keep`, from `n_nodes` and
    `n_values` on. Returns the new `n_nodes`, `n_values`, and the tree's depth.
    """
    min_split, min_leaf, max_features, max_depth = settings
    node, depth, deepest, top = n_nodes, 0, 0, 0
    n_nodes += 1
    size, q_size = U(fitted.size), U(queried.size)
    start, stop, q_start, q_stop = ZERO, size, ZERO, q_size
    both = d == TWO and max_features >= 2
    while True:
        here = plane(depth) * size
        base = here * d
        feature, cut, w_left, s_left = -1, np.int32(0), np.int64(0), np.int64(0)
        if (
            w_node >= min_split
            and depth < max_depth
            and w_node >= 2 * min_leaf
            and not is_pure(target, weight, here + start, here + stop, w_node, unit)
        ):
            if both:
                split, state = choose_two(
                    words,
                    target,
                    weight,
                    here,
                    start,
                    stop,
                    w_node,
                    s_node,
                    min_leaf,
                    state,
                )
            else:
                split, state = choose(
                    keys,
                    target,
                    weight,
                    base,
                    here,
                    start,
                    stop,
                    w_node,
                    s_node,
                    min_leaf,
                    state,
                    max_features,
                    order,
                )
            feature, cut, w_left, s_left = split
        if feature < 0:
            value = s_node * unit / w_node
            add_value(row, here + start, here + stop, value, fitted)
            q_here = plane(depth) * q_size
            add_value(q_row, q_here + q_start, q_here + q_stop, value, queried)
            if keep:
                nodes[node].cut = 0
                nodes[node].feature = -1
                nodes[node].child = n_values
                values[n_values] = value
            n_values += 1
            deepest = max(deepest, depth)
            if top == 0:
                return n_nodes, n_values, deepest
            top -= 1
            node, depth = stack[top, 0], stack[top, 1]
            start, stop = U(stack[top, 2]), U(stack[top, 3])
            q_start, q_stop = U(stack[top, 4]), U(stack[top, 5])
            w_node, s_node = stack[top, 6], stack[top, 7]
            continue
        middle = move_rows(
            keys, words, row, target, weight, size, d, depth, start, stop, feature, cut
        )
        q_middle = q_start
        if q_start < q_stop:
            q_middle = move_queries(
                q_keys, q_words, q_row, q_size, d, depth, q_start, q_stop, feature, cut
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
        stack[top, 6], stack[top, 7] = w_node - w_left, s_node - s_left
        top += 1
        stop, q_stop, w_node, s_node = middle, q_middle, w_left, s_left


@njit
def grown(array, size):
    """A copy of `array` with room for `size` elements."""
    larger = np.empty(size, array.dtype)
    larger[: array.size] = array
    return larger


@njit
def grow_forest(x, y, multiplicity, seeds, queries, settings, keep):
    """Grow one tree per seed and predict at the training and the query rows.

    x: (n, d) float32; y: (n,) float64; multiplicity: (n,) int64, or empty if all are 1;
    seeds: (T,) uint64; queries: (m, d) float32; settings: min_samples_split,
    min_samples_leaf, max_features, max_depth.
    Returns nodes, leaf values, first node of each tree (T+1,), depths (T,), fitted
    (n,), queried (m,); nodes and values are empty unless `keep`.
    """
    weighted = multiplicity.size > 0
    keys, words, row, target, weight = new_rows(x, True, weighted)
    q_keys, q_words, q_row, _, _ = new_rows(queries, False, False)
    w_all, largest = np.int64(0), 0.0
    for i in range(y.size):
        w_all += multiplicity[i] if weighted else 1
        largest = max(largest, abs(y[i]))
    bits = 0.0
    if largest > 0.0:  # as many as keep every sum of targets below 2^62
        bits = min(62.0 - np.ceil(np.log2(largest) + np.log2(w_all)), 1000.0)
    s_all = np.int64(0)
    for i in range(y.size):
        target[i] = np.int64(np.rint(y[i] * 2.0**bits))
        if weighted:
            weight[i] = multiplicity[i]
        s_all += target[i] * (multiplicity[i] if weighted else 1)
    fitted, queried = np.zeros(x.shape[0]), np.zeros(queries.shape[0])
    order = np.arange(x.shape[1])
    stack = np.empty((x.shape[0] + 1, 8), np.int64)
    trees = seeds.size
    first, depths = np.zeros(trees + 1, np.int64), np.empty(trees, np.int64)
    most = x.shape[0]  # leaves a tree can have
    nodes = np.empty(2 * most if keep else 0, NODE)
    values = np.empty(most if keep else 0, np.float64)
    leaves = 0
    for t in range(trees):
        if keep and leaves + most > values.size:
            room = leaves + most + (trees - t) * leaves // t
            nodes, values = grown(nodes, 2 * room), grown(values, room)
        first[t + 1], leaves, depths[t] = grow_tree(
            keys,
            words,
            row,
            target,
            weight,
            q_keys,
            q_words,
            q_row,
            U(x.shape[1]),
            w_all,
            s_all,
            2.0**-bits,
            settings,
            seeds[t],
            order,
            stack,
            fitted,
            queried,
            nodes,
            first[t],
            values,
            leaves,
            keep,
        )
    if keep:
        nodes, values = nodes[: first[trees]].copy(), values[:leaves].copy()
    return nodes, values, first, depths, fitted / trees, queried / trees
