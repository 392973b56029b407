"""The split of a node with all features tried, four features of a row at a time.

`choose_all` gives the same trees as `split.choose`, bit for bit; it reads a row's keys
as LLVM vectors, which become SIMD instructions on any processor. Keys are padded to
whole vectors; nothing that is found in the padding is used.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import models, register_model

from bcrl.common.compiling import compiled, instructions
from bcrl.q.forest.split import (
    GOLDEN,
    LOW32,
    Split,
    U,
    draw_cut,
    gain,
    mix,
    uncounted,
)

LANES = 4  # of int32 keys in a vector; wide enough for AVX2, whose int64 sums are four
CHUNK = U(128)  # rows that stay in the cache while all vectors of a row are read


class Vector(types.Type):
    """LANES integers as one value of compiled code."""

    def __init__(self, bits: int) -> None:
        self.lanes = ir.VectorType(ir.IntType(bits), LANES)
        super().__init__(f"Vector({bits})")


@register_model(Vector)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Vector) -> None:
        super().__init__(manager, kind, kind.lanes)


def _place(context, b, signature, args):
    """Where the vector at args[1] of the array args[0] lies, and its alignment."""
    kind = signature.args[0]
    start = b.gep(context.make_array(kind)(context, b, args[0]).data, [args[1]])
    lanes = Vector(kind.dtype.bitwidth).lanes
    return b.bitcast(start, lanes.as_pointer()), kind.dtype.bitwidth // 8


@instructions
def vector_at(typing, array, i):
    """The vector array[i : i + LANES]."""

    def generate(context, b, signature, args):
        where, align = _place(context, b, signature, args)
        return b.load(where, align=align)

    return Vector(array.dtype.bitwidth)(array, types.uint64), generate


@instructions
def store(typing, array, i, vector):
    """array[i : i + LANES] = vector."""

    def generate(context, b, signature, args):
        where, align = _place(context, b, signature, args)
        b.store(args[2], where, align=align)

    return types.void(array, types.uint64, vector), generate


@instructions
def lesser(typing, one, other):
    """The lesser of two vectors, lane by lane."""

    def generate(context, b, signature, args):
        return b.select(b.icmp_signed("<", *args), *args)

    return one(one, other), generate


@instructions
def greater(typing, one, other):
    """The greater of two vectors, lane by lane."""

    def generate(context, b, signature, args):
        return b.select(b.icmp_signed(">", *args), *args)

    return one(one, other), generate


@instructions
def add_left(typing, total, keys, cuts, value):
    """`total` (int64) plus `value` in the lanes where keys <= cuts."""

    def generate(context, b, signature, args):
        total, keys, cuts, value = args
        empty = ir.Constant(total.type, ir.Undefined)
        one = b.insert_element(empty, value, ir.IntType(32)(0))
        order = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        values = b.shuffle_vector(one, empty, order)
        left = b.sext(b.icmp_signed("<=", keys, cuts), total.type)
        return b.add(total, b.and_(left, values))

    return total(total, keys, cuts, types.int64), generate


@compiled()
def new_sums(width):
    """The arrays that `choose_all` needs for rows of `width` keys, padding included."""
    extremes, sums = np.zeros((3, width), np.int32), np.zeros((2, width), np.int64)
    return extremes[0], extremes[1], extremes[2], sums[0], sums[1]


@uncounted
def choose_all(
    rows, first, last, node_weight, node_total, min_leaf, state, order, sums
):
    """`split.choose` with all features tried, in two passes over the rows."""
    keys, target, weight = rows.keys, rows.target, rows.weight
    low, high, cuts, weights, totals = sums
    width, step = U(low.size), U(LANES)
    for g in range(U(0), width, step):
        row = vector_at(keys, first * width + g)
        store(low, g, row)
        store(high, g, row)
    for start in range(first, last, CHUNK):
        stop = min(start + CHUNK, last)
        for g in range(U(0), width, step):
            least, most = vector_at(low, g), vector_at(high, g)
            for i in range(start, stop):
                row = vector_at(keys, i * width + g)
                least, most = lesser(least, row), greater(most, row)
            store(low, g, least)
            store(high, g, most)
    for left in range(order.size - 1, -1, -1):  # the draws of `split.choose`
        state += GOLDEN
        bits = mix(state)
        pick = np.int64(((bits & LOW32) * U(left + 1)) >> U(32))
        feature = order[pick]
        order[pick], order[left] = order[left], feature
        cuts[feature] = draw_cut(low[feature], high[feature], bits >> U(32))

    for g in range(U(0), width):
        weights[g] = totals[g] = 0
    for start in range(first, last, CHUNK):
        stop = min(start + CHUNK, last)
        for g in range(U(0), width, step):
            cut, w, s = vector_at(cuts, g), vector_at(weights, g), vector_at(totals, g)
            for i in range(start, stop):
                row = vector_at(keys, i * width + g)
                count = weight[i] if weight.size > 0 else np.int64(1)
                w = add_left(w, row, cut, count)
                s = add_left(s, row, cut, count * target[i])
            store(weights, g, w)
            store(totals, g, s)
    best, split = -1.0, Split(-1, np.int32(0), np.int64(0), np.int64(0))
    for visited in range(order.size - 1, -1, -1):
        f = order[visited]
        w, s = weights[f], totals[f]
        score = gain(low[f], high[f], w, s, node_weight, node_total, min_leaf)
        if score > best:
            best, split = score, Split(f, cuts[f], w, s)
    return split, state
