"""Compiled extra-trees: grows a forest and carries query rows down while it grows.

Three representations make the loops fast and the results exact:

* features are **keys**, integers ordered like the float32 values they stand for, so
  that comparisons and minima are integer operations, which vectorise;
* targets are **fixed-point** int64, so that sums are exact and independent of the order
  of rows, of the vector width and of the machine (sums of floats are none of these);
* the rows of a node lie side by side in every buffer: a split moves them from one
  buffer into the other, so that memory is read in sequence.

Because sums are exact, a row of multiplicity 3 and three equal rows give the same tree
bit for bit, and so does any order of the rows.

A buffer holds three **planes**: the rows as given, and two that levels of the tree use
in turn. Indices are unsigned because numba checks signed ones for being negative.
"""

from __future__ import annotations

import numpy as np
from numba import njit

#: One tree node, 12 bytes: rows with `key <= cut` go to node `child`, others to
#: `child + 1`; a leaf has feature −1 and its value at `child` in the leaf values.
NODE = np.dtype([("cut", np.int32), ("feature", np.int32), ("child", np.int32)])

#: Variance of the targets up to which a node is a leaf: float64's eps, in units of the
#: target squared (scikit-learn's rule).
PURE = float(np.finfo(np.float64).eps)
#: Range up to which a feature counts as constant in a node (scikit-learn's rule).
CONSTANT = np.float32(1e-7)

U = np.uint64
ZERO, ONE, TWO = U(0), U(1), U(2)
GOLDEN, LOW32 = U(0x9E3779B97F4A7C15), U(0xFFFFFFFF)
SIGN, REST = np.int32(31), np.int32(0x7FFFFFFF)


@njit
def key_of(value):
    """The int32 that orders like the float32 `value`; −0 is taken as +0."""
    bits = np.float32(value + np.float32(0.0)).view(np.int32)
    return np.int32(bits ^ ((bits >> SIGN) & REST))


@njit
def value_of(key):
    """The float32 that the int32 `key` stands for."""
    return np.int32(key ^ ((key >> SIGN) & REST)).view(np.float32)


@njit
def mix(state):
    """Output function of splitmix64 (Steele, Lea and Flood 2014), uint64 to uint64."""
    z = (state ^ (state >> U(30))) * U(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> U(27))) * U(0x94D049BB133111EB)
    return z ^ (z >> U(31))


@njit
def draw_cut(low, high, bits):
    """Key of a threshold uniform on [low, high), given 32 random bits.

    The threshold is drawn in float64 and rounded down to float32, which changes
    `x <= threshold` for no float32 x.
    """
    floor, top = np.float64(value_of(low)), np.float64(value_of(high))
    threshold = floor + (top - floor) * (np.float64(bits) * 2.0**-32)
    if threshold >= top:
        threshold = floor
    near = np.float32(threshold)
    return np.int32(key_of(near) - np.int32(np.float64(near) > threshold))


@njit
def is_pure(target, weight, start, stop, total_weight, unit):
    """Whether the variance of `target[start:stop]` is at most PURE.

    Two rows at a distance δ alone give a variance of δ² / (2 · total weight) or more:
    a mixed node is told after a row or two.
    """
    first = target[start]
    limit = 2.0 * total_weight * PURE
    mean, square = 0.0, 0.0
    for i in range(start, stop):
        far = np.float64(target[i] - first) * unit
        if far * far > limit:
            return False
        share = (weight[i] if weight.size > 0 else 1) / total_weight
        mean += share * far
        square += share * far * far
    return square - mean * mean <= PURE


@njit
def bounds(keys, start, stop):
    """Smallest and largest of `keys[start:stop]`."""
    low = keys[start]
    high = low
    for i in range(start + ONE, stop):
        low = min(low, keys[i])
        high = max(high, keys[i])
    return low, high


@njit
def left_sums(keys, base, target, weight, start, stop, cut):
    """Weight and weighted sum of targets over the rows that go left."""
    count, total = np.int64(0), np.int64(0)
    if weight.size > 0:
        for i in range(start, stop):
            goes = -np.int64(keys[base + i] <= cut)
            count += weight[i] & goes
            total += (weight[i] * target[i]) & goes
    else:
        for i in range(start, stop):
            goes = -np.int64(keys[base + i] <= cut)
            count -= goes
            total += target[i] & goes
    return count, total


@njit
def move_rows(keys, base, out, size, d, by, start, stop, cut, row, target, weight, a, b):
    """Move rows to the other plane, those with `key <= cut` first; where these end.

    `base`, `out`: where the two planes of keys start; `a`, `b`: of everything else.
    """
    left, right = start, stop - ONE
    if d == TWO and weight.size == 0:
        for i in range(start, stop):
            goes = U(keys[by + i] <= cut)
            p = left if goes else right
            keys[out + p] = keys[base + i]
            keys[out + size + p] = keys[base + size + i]
            row[b + p] = row[a + i]
            target[b + p] = target[a + i]
            left += goes
            right -= ONE - goes
    else:
        for i in range(start, stop):
            goes = U(keys[by + i] <= cut)
            p = left if goes else right
            for f in range(d):
                keys[out + f * size + p] = keys[base + f * size + i]
            row[b + p] = row[a + i]
            target[b + p] = target[a + i]
            if weight.size > 0:
                weight[b + p] = weight[a + i]
            left += goes
            right -= ONE - goes
    return left


@njit
def move_queries(keys, base, out, size, d, by, start, stop, cut, row, a, b):
    """`move_rows` for query rows, which carry no target."""
    left, right = start, stop - ONE
    if d == TWO:
        for i in range(start, stop):
            goes = U(keys[by + i] <= cut)
            p = left if goes else right
            keys[out + p] = keys[base + i]
            keys[out + size + p] = keys[base + size + i]
            row[b + p] = row[a + i]
            left += goes
            right -= ONE - goes
    else:
        for i in range(start, stop):
            goes = U(keys[by + i] <= cut)
            p = left if goes else right
            for f in range(d):
                keys[out + f * size + p] = keys[base + f * size + i]
            row[b + p] = row[a + i]
            left += goes
            right -= ONE - goes
    return left


@njit
def choose(
    keys, base, size, target, weight, a, start, stop, total, total_sum,
    min_leaf, max_features, order, state,
):
    """The best of the tried features by variance reduction, each cut at random."""
    best, feature, best_cut = -1.0, -1, np.int32(0)
    best_weight, best_sum = np.int64(0), np.int64(0)
    left = order.size
    visited, constants = 0, 0
    while left > 0 and (visited < max_features or visited == constants):
        state += GOLDEN
        bits = mix(state)
        pick = np.int64(((bits & LOW32) * U(left)) >> U(32))
        left -= 1
        f = order[pick]
        order[pick] = order[left]
        order[left] = f
        visited += 1
        column = base + U(f) * size
        low, high = bounds(keys, column + start, column + stop)
        if value_of(high) <= np.float32(value_of(low) + CONSTANT):
            constants += 1
            continue
        cut = draw_cut(low, high, bits >> U(32))
        w_left, s_left = left_sums(
            keys, column - a, target, weight, a + start, a + stop, cut
        )
        w_right = total - w_left
        if w_left < min_leaf or w_right < min_leaf:
            continue
        gap = np.float64(s_left) * w_right - np.float64(total_sum - s_left) * w_left
        score = gap * gap / (np.float64(w_left) * w_right)
        if score > best:
            best, feature, best_cut = score, f, cut
            best_weight, best_sum = w_left, s_left
    return feature, best_cut, best_weight, best_sum, state


@njit
def grow_tree(
    keys, target, weight, row, qkeys, qrow, none, d, n, m, total_weight, total_sum, unit,
    min_split, min_leaf, max_features,
    state, order, stack, fitted, queried, nodes, values, keep,
):
    n_nodes, n_leaves, deepest, top = 1, 0, 0, 0
    node, depth = 0, 0
    start, stop, qstart, qstop = ZERO, n, ZERO, m
    w_node, s_node = total_weight, total_sum
    dn, dm = d * n, d * m
    while True:
        feature = -1
        cut = np.int32(0)
        w_left, s_left = np.int64(0), np.int64(0)
        src = U(0) if depth == 0 else U(2 - (depth & 1))
        x0 = src * dn
        y0 = src * n
        if w_node >= min_split and w_node >= 2 * min_leaf and not is_pure(
            target, weight, y0 + start, y0 + stop, w_node, unit
        ):
            feature, cut, w_left, s_left, state = choose(keys, x0, n, target, weight, y0, start, stop, w_node, s_node, min_leaf, max_features, order, state)
        if feature < 0:
            value = s_node * unit / w_node
            for i in range(y0 + start, y0 + stop):
                fitted[row[i]] += value
            q0 = src * m
            for i in range(q0 + qstart, q0 + qstop):
                queried[qrow[i]] += value
            if keep:
                nodes[node].cut = 0
                nodes[node].feature = -1
                nodes[node].child = n_leaves
                values[n_leaves] = value
            n_leaves += 1
            deepest = max(deepest, depth)
            if top == 0:
                break
            top -= 1
            node = stack[top, 0]
            depth = stack[top, 1]
            start, stop = U(stack[top, 2]), U(stack[top, 3])
            qstart, qstop = U(stack[top, 4]), U(stack[top, 5])
            w_node, s_node = stack[top, 6], stack[top, 7]
            continue
        dst = U(2 - ((depth + 1) & 1))
        left = move_rows(keys, x0, dst*dn, n, d, x0+U(feature)*n, start, stop, cut, row, target, weight, y0, dst*n)
        qleft = qstart
        if qstart < qstop:
            qleft = move_queries(qkeys, src*dm, dst*dm, m, d, src*dm+U(feature)*m, qstart, qstop, cut, qrow, src*m, dst*m)
        child = n_nodes
        n_nodes += 2
        if keep:
            nodes[node].cut = cut
            nodes[node].feature = feature
            nodes[node].child = child
        depth += 1
        stack[top, 0] = child + 1
        stack[top, 1] = depth
        stack[top, 2] = left
        stack[top, 3] = stop
        stack[top, 4] = qleft
        stack[top, 5] = qstop
        stack[top, 6] = w_node - w_left
        stack[top, 7] = s_node - s_left
        top += 1
        node = child
        stop = left
        qstop = qleft
        w_node, s_node = w_left, s_left
    return n_nodes, n_leaves, deepest
@njit(nogil=True)
def grow_forest(x, y, mult, seeds, queries, min_split, min_leaf, max_features, keep):
    n, d = U(x.shape[0]), U(x.shape[1])
    m = U(queries.shape[0])
    weighted = mult.size > 0
    total_weight = np.int64(0)
    if weighted:
        for i in range(mult.size):
            total_weight += mult[i]
    else:
        total_weight = np.int64(n)
    big = 0.0
    for i in range(y.size):
        big = max(big, abs(y[i]))
    bits = 61 - int(np.ceil(np.log2(big * total_weight))) if big > 0 else 0
    unit = 2.0 ** -bits
    keys = np.empty(U(3) * d * n, np.int32)
    target = np.empty(U(3) * n, np.int64)
    weight = np.empty(U(3) * n if weighted else ZERO, np.int64)
    row = np.empty(U(3) * n, np.uint32)
    qkeys = np.empty(U(3) * d * m, np.int32)
    qrow = np.empty(U(3) * m, np.uint32)
    total_sum = np.int64(0)
    for i in range(n):
        target[i] = np.int64(np.rint(y[i] * 2.0**bits))
        row[i] = i
        if weighted:
            weight[i] = mult[i]
            total_sum += target[i] * mult[i]
        else:
            total_sum += target[i]
        for f in range(d):
            keys[f * n + i] = key_of(x[i, f])
    for i in range(m):
        qrow[i] = i
        for f in range(d):
            qkeys[f * m + i] = key_of(queries[i, f])
    fitted = np.zeros(n)
    queried = np.zeros(m)
    none = np.empty(0, np.int64)
    order = np.arange(x.shape[1])
    stack = np.empty((n + ONE, 8), np.int64)
    nodes = np.empty(U(2) * n if keep else ZERO, NODE)
    values = np.empty(n if keep else ZERO, np.float64)
    counts = np.empty(seeds.size, np.int64)
    depths = np.empty(seeds.size, np.int64)
    for t in range(seeds.size):
        a, b, c = grow_tree(
            keys, target, weight, row, qkeys, qrow, none,
            d, n, m, total_weight, total_sum, unit,
            min_split, min_leaf, max_features,
            seeds[t], order, stack, fitted, queried, nodes, values, keep,
        )
        counts[t], depths[t] = a, c
    return counts, depths, fitted / seeds.size, queried / seeds.size
