"""Compiled parts of the forest: keys, random cuts and the choice of a split.

Features are **keys**, integers ordered like the float32 values they stand for, so that
comparisons vectorise. Targets are **fixed-point** int64, so that sums are exact and do
not depend on the order of rows or on the machine: a row of multiplicity 3 and three
equal rows give the same tree. Indices are unsigned: numba checks signed ones for < 0.
"""

from typing import NamedTuple

import numpy as np

from bcrl.common.compiling import compiled

#: One tree node, 12 bytes: rows with `key <= cut` go to node `child`, others to
#: `child + 1`; a leaf has feature −1 and its value at `child` in the leaf values.
NODE = np.dtype([("cut", np.int32), ("feature", np.int32), ("child", np.int32)])

#: Variance of the targets up to which a node is a leaf, and range up to which a feature
#: counts as constant in a node: scikit-learn's.
PURE, CONSTANT = float(np.finfo(np.float64).eps), np.float32(1e-7)

U = np.uint64
GOLDEN, LOW32 = U(0x9E3779B97F4A7C15), U(0xFFFFFFFF)
SIGN, REST = np.int32(31), np.int32(0x7FFFFFFF)
HALF = np.int64(32)  # bits of a key in a word

#: Functions that make no arrays need no reference counting, which costs more than the
#: work in a small node.
uncounted = compiled(_nrt=False)
#: The same, inlined into the caller, because passing arrays costs as much again.
inlined = compiled(_nrt=False, inline="always")


@inlined
def key_of(value):
    """The int32 that orders like the float32 `value`; −0 is taken as +0."""
    bits = np.float32(value + np.float32(0.0)).view(np.int32)
    return np.int32(bits ^ ((bits >> SIGN) & REST))


@inlined
def value_of(key):
    """The float32 that the int32 `key` stands for."""
    return np.int32(key ^ ((key >> SIGN) & REST)).view(np.float32)


@inlined
def mix(state):
    """Output function of splitmix64 (Steele, Lea and Flood 2014), uint64 to uint64."""
    z = (state ^ (state >> U(30))) * U(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> U(27))) * U(0x94D049BB133111EB)
    return z ^ (z >> U(31))


@inlined
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


class Split(NamedTuple):
    """A chosen split: feature (−1: none), cut, weight and target sum of the left."""

    feature: int
    cut: np.int32
    weight: np.int64
    total: np.int64


@inlined
def is_pure(rows, start, stop, total_weight, unit):
    """Whether the variance of the targets at `start:stop` is at most PURE.

    Two rows at a distance δ alone give a variance of at least δ² / (2 · total weight).
    """
    target, weight, mean, square = rows.target, rows.weight, 0.0, 0.0
    first, limit = target[start], 2.0 * total_weight * PURE
    for i in range(start + U(1), stop):
        far = np.float64(target[i] - first) * unit
        if far * far > limit:
            return False
        share = (weight[i] if weight.size > 0 else 1) / total_weight
        mean += share * far
        square += share * far * far
    return square - mean * mean <= PURE


@inlined
def gain(low, high, weight, total, node_weight, node_total, min_leaf):
    """Variance reduction of a split up to a factor of the node; −1 if not allowed.

    Mirrored splits give exactly the same number, so that ties are ties.
    """
    right = node_weight - weight
    too_few = weight < min_leaf or right < min_leaf
    if too_few or value_of(high) <= np.float32(value_of(low) + CONSTANT):
        return -1.0
    gap = np.float64(total) * right - np.float64(node_total - total) * weight
    return gap * gap / (np.float64(weight) * right)


@inlined
def choose_two(rows, first, last, node_weight, node_total, min_leaf, state):
    """`choose` for two features that are both tried, in two passes over the rows."""
    words, target, weight = rows.words, rows.target, rows.weight
    low0 = high0 = np.int32(words[first])
    low1 = high1 = np.int32(words[first] >> HALF)
    for i in range(first + U(1), last):
        key0, key1 = np.int32(words[i]), np.int32(words[i] >> HALF)
        low0, high0 = min(low0, key0), max(high0, key0)
        low1, high1 = min(low1, key1), max(high1, key1)
    state += GOLDEN
    bits = mix(state)
    cut0 = draw_cut(low0, high0, bits >> U(32))
    cut1 = draw_cut(low1, high1, bits & LOW32)
    weight0 = total0 = weight1 = total1 = np.int64(0)
    for i in range(first, last):
        left0 = -np.int64(np.int32(words[i]) <= cut0)  # all bits, or none
        left1 = -np.int64(np.int32(words[i] >> HALF) <= cut1)
        w, y = np.int64(1), target[i]
        if weight.size > 0:
            w = weight[i]
            y *= w
        weight0 += w & left0
        total0 += y & left0
        weight1 += w & left1
        total1 += y & left1
    gain0 = gain(low0, high0, weight0, total0, node_weight, node_total, min_leaf)
    gain1 = gain(low1, high1, weight1, total1, node_weight, node_total, min_leaf)
    second = gain1 > gain0
    if gain0 == gain1:
        state += GOLDEN
        second = (mix(state) >> U(63)) == U(1)
    if max(gain0, gain1) < 0.0:
        return Split(-1, cut0, weight0, total0), state
    if second:
        return Split(1, cut1, weight1, total1), state
    return Split(0, cut0, weight0, total0), state


@uncounted
def choose(rows, width, first, last, node_weight, node_total, limits, state, order):
    """The best of the tried features by variance reduction, each cut at random.

    Features are visited in random order, so that ties between them fall either way. A
    constant feature counts as tried, but at least one other is tried (scikit-learn's).
    first, last: the node's rows; node_weight, node_total: their weight and sum of
    targets; limits: (min_samples_leaf, max_features); order: a permutation of the
    features, which is shuffled further. Returns a Split and `state`.
    """
    keys, target, weight = rows.keys, rows.target, rows.weight
    min_leaf, max_features = limits
    best, split = -1.0, Split(-1, np.int32(0), np.int64(0), np.int64(0))
    left, tried, constants = order.size, 0, 0
    while left > 0 and (tried < max_features or tried == constants):
        state += GOLDEN
        bits = mix(state)
        pick = np.int64(((bits & LOW32) * U(left)) >> U(32))
        left -= 1
        tried += 1
        feature = order[pick]
        order[pick], order[left] = order[left], feature
        column = U(feature)
        low = high = keys[column + first * width]
        for i in range(first + U(1), last):
            key = keys[column + i * width]
            low, high = min(low, key), max(high, key)
        if value_of(high) <= np.float32(value_of(low) + CONSTANT):
            constants += 1
            continue
        cut = draw_cut(low, high, bits >> U(32))
        w = s = np.int64(0)
        for i in range(first, last):
            goes_left = -np.int64(keys[column + i * width] <= cut)  # all bits, or none
            count = weight[i] if weight.size > 0 else np.int64(1)
            w += count & goes_left
            s += (count * target[i]) & goes_left
        score = gain(low, high, w, s, node_weight, node_total, min_leaf)
        if score > best:
            best, split = score, Split(feature, cut, w, s)
    return split, state
