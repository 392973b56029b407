"""Moving a node's rows of two features, eight rows at a time, with AVX-512.

The rows come in **groups** of `GROUP`, and lanes beyond the node's end are masked: most
nodes are one group. Groups are read and stored beyond a node's end, so arrays have room
for `GROUP` rows more.
"""

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from bcrl.common.compiling import cpu_features, instructions
from bcrl.q.forest.split import U, inlined

GROUP = 8
#: Whether one instruction puts the lanes of a vector in any order, as `sift` needs.
SHUFFLE = {"+avx2", "+avx512f", "+avx512vl"} <= cpu_features()

I8, I32, I64 = (ir.IntType(bits) for bits in (8, 32, 64))
WORDS, NUMBERS = ir.VectorType(I64, GROUP), ir.VectorType(I32, GROUP)
LANE = WORDS(list(range(GROUP)))
#: Instructions that put a vector's lanes in a given order, by the lanes' width.
PERMUTE = {64: "llvm.x86.avx512.permvar.di.512", 32: "llvm.x86.avx2.permd"}


def _order(chosen: int) -> int:
    """Numbers of the lanes whose bits are set, then of the others, a byte each."""
    lanes = sorted(range(GROUP), key=lambda lane: not chosen >> lane & 1)
    return int.from_bytes(bytes(lanes), "little")


ORDERS = ir.ArrayType(I64, 2**GROUP)([_order(chosen) for chosen in range(2**GROUP)])


def _splat(b: ir.IRBuilder, value: ir.Value) -> ir.Value:
    """A vector with `value` in every lane."""
    none = ir.Constant(ir.VectorType(value.type, GROUP), ir.Undefined)
    return b.shuffle_vector(b.insert_element(none, value, I32(0)), none, NUMBERS(None))


def _call(b: ir.IRBuilder, name: str, result: ir.Type, *args: ir.Value) -> ir.Value:
    """A call of one of LLVM's own functions."""
    kind = ir.FunctionType(result, [arg.type for arg in args])
    return b.call(cgutils.get_or_insert_function(b.module, kind, name), args)


def _at(context, b, kind, array, i):
    """Where the group of an array begins that starts with element `i`."""
    start = b.gep(context.make_array(kind)(context, b, array).data, [i])
    return b.bitcast(start, ir.VectorType(start.type.pointee, GROUP).as_pointer())


def _load(b: ir.IRBuilder, where: ir.Value) -> ir.Value:
    return b.load(where, align=where.type.pointee.element.width // 8)


def _limit(b: ir.IRBuilder, cut: ir.Value) -> ir.Value:
    """The greatest word whose upper key is at most `cut`, in every lane."""
    upper = b.shl(b.sext(cut, I64), I64(32))
    return _splat(b, b.or_(upper, I64(0xFFFFFFFF)))


@instructions
def _sift(typing, columns, source, end, left, right, rise, cut):
    """Move the group at `source`, of rows before `end`, to `left` on or up to `right`.

    Rows whose words, moved up by `rise` bits, have an upper key of at most `cut` go
    left. Returns how many do.
    """

    def generate(context, b, signature, args):
        columns, source, end, left, right, rise, cut = args
        arrays = cgutils.unpack_tuple(b, columns)
        pairs = list(zip(signature.args[0], arrays, strict=True))
        groups = [_load(b, _at(context, b, *pair, source)) for pair in pairs]
        rest = b.sub(end, source)
        rest = b.select(b.icmp_unsigned("<", rest, I64(GROUP)), rest, I64(GROUP))
        alive = b.icmp_unsigned("<", LANE, _splat(b, rest))
        raised = b.shl(groups[0], _splat(b, rise))
        goes_left = b.icmp_signed("<=", raised, _limit(b, cut))
        chosen = b.bitcast(b.and_(goes_left, alive), I8)
        moved = b.zext(_call(b, "llvm.ctpop.i8", I8, chosen), I64)
        first = b.icmp_unsigned("<", LANE, _splat(b, moved))
        second = b.and_(b.not_(first), alive)
        table = cgutils.global_constant(b.module, "bcrl.orders", ORDERS)
        order = b.load(b.gep(table, [I64(0), b.zext(chosen, I64)]))
        order = b.bitcast(order, ir.VectorType(I8, GROUP))
        ends = ((left, first), (b.sub(b.add(right, I64(1)), rest), second))
        for pair, group in zip(pairs, groups, strict=True):
            width = group.type.element.width
            index = b.zext(order, group.type)
            packed = _call(b, PERMUTE[width], group.type, group, index)
            for start, lanes in ends:
                # Blended and stored whole: a masked store is slow to be read again.
                where = _at(context, b, *pair, start)
                whole = b.select(lanes, packed, _load(b, where))
                b.store(whole, where, align=width // 8)
        return moved

    places = [types.uint64] * 4
    return types.uint64(columns, *places, types.int64, types.int32), generate


@inlined
def sift(columns, start, stop, to, feature, cut):
    """Move rows `start:stop` of some arrays, words first, to `to`, the left ones first.

    Returns where the left ones end. It needs `SHUFFLE`.
    """
    left, right = to, to + (stop - start) - U(1)
    rise = np.int64(32) * (1 - feature)
    for i in range(start, stop, U(GROUP)):
        moved = _sift(columns, i, stop, left, right, rise, cut)
        left += moved
        right -= min(U(GROUP), stop - i) - moved
    return left
