"""Passes over the rows of a node, eight rows at a time, as LLVM vectors.

Most nodes of a tree are small, and a loop that the compiler makes fast for hundreds of
rows takes ten of them one by one. Here a node's rows come in groups of `LANES`, lanes
beyond its end masked: a small node is one group, without a branch. The vectors fit any
processor; only `sift` needs instructions of AVX-512, and `SHUFFLE` says whether numba
compiles for them. All operations are on integers, so that no sum depends on the groups.

Groups are read and blended beyond a node's end, so buffers have room for `LANES` rows
more. Rows of two features are `words`, int64 with feature 0's key in the lower half.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from llvmlite import ir
from numba import types
from numba.core import cgutils, codegen, config
from numba.extending import intrinsic

LANES = 8
_OURS = config.CPU_FEATURES
FEATURES = set((codegen.get_host_cpu_features() if _OURS is None else _OURS).split(","))
#: Whether one instruction puts the lanes of a vector in any order.
SHUFFLE = {"+avx2", "+avx512f", "+avx512vl"} <= FEATURES

I8, I32, I64 = (ir.IntType(bits) for bits in (8, 32, 64))


def vector(element: ir.Type, lanes: int = LANES) -> ir.VectorType:
    return ir.VectorType(element, lanes)


def _order(chosen: int) -> int:
    """Numbers of the lanes whose bits are set, then of the others, a byte each."""
    lanes = sorted(range(LANES), key=lambda lane: not chosen >> lane & 1)
    return int.from_bytes(bytes(lanes), "little")


_NUMBERS = vector(I64)(list(range(LANES)))
_ORDERS = ir.ArrayType(I64, 2**LANES)([_order(chosen) for chosen in range(2**LANES)])
#: Instructions that put a vector's lanes in a given order, by the lanes' width.
_PERMUTE = {64: "llvm.x86.avx512.permvar.di.512", 32: "llvm.x86.avx2.permd"}


def splat(b: ir.IRBuilder, value: ir.Value, lanes: int = LANES) -> ir.Value:
    """A vector with `value` in every lane."""
    none = ir.Constant(vector(value.type, lanes), ir.Undefined)
    one = b.insert_element(none, value, I32(0))
    return b.shuffle_vector(one, none, vector(I32, lanes)([0] * lanes))


def call(b: ir.IRBuilder, name: str, result: ir.Type, *args: ir.Value) -> ir.Value:
    """A call of one of LLVM's own functions."""
    kind = ir.FunctionType(result, [arg.type for arg in args])
    return b.call(cgutils.get_or_insert_function(b.module, kind, name), args)


def _at(context, b: ir.IRBuilder, kind: types.Array, array, i: ir.Value) -> ir.Value:
    """Where a group of `array` begins that starts with element `i`."""
    start = b.gep(context.make_array(kind)(context, b, array).data, [i])
    return b.bitcast(start, vector(start.type.pointee).as_pointer())


def _load(b: ir.IRBuilder, where: ir.Value) -> ir.Value:
    return b.load(where, align=where.type.pointee.element.width // 8)


@contextmanager
def _groups(b: ir.IRBuilder, start, stop) -> Iterator[tuple[ir.Value, ir.Value]]:
    """A loop over the groups of `start:stop`: where each begins, its living lanes."""
    with cgutils.for_range_slice(b, start, stop, I64(LANES)) as (i, _):
        rest = splat(b, b.sub(stop, i))
        yield i, b.icmp_unsigned("<", _NUMBERS, rest)


def _limit(b: ir.IRBuilder, cut: ir.Value) -> ir.Value:
    """The greatest word whose upper key is at most `cut`, in every lane."""
    upper = b.shl(b.sext(cut, I64), I64(32))
    return splat(b, b.or_(upper, I64(0xFFFFFFFF)))


def _fold(b: ir.IRBuilder, vector: ir.Value, name: str) -> ir.Value:
    """All lanes taken together by LLVM's reduction `name`."""
    element = vector.type.element
    full = f"llvm.vector.reduce.{name}.v{LANES}i{element.width}"
    return call(b, full, element, vector)


@intrinsic
def extremes(typing, words, start, stop):
    """Least and greatest key of feature 0, then of feature 1, in rows `start:stop`."""

    def generate(context, b, signature, args):
        words, start, stop = args
        kind = signature.args[0]
        first = b.load(b.gep(context.make_array(kind)(context, b, words).data, [start]))
        filler, pairs = splat(b, first), vector(I32, 2 * LANES)
        keys = b.bitcast(filler, pairs)
        best = [(sign, cgutils.alloca_once_value(b, keys)) for sign in "<>"]
        with _groups(b, start, stop) as (i, alive):
            group = b.select(alive, _load(b, _at(context, b, kind, words, i)), filler)
            keys = b.bitcast(group, pairs)
            for sign, kept in best:
                old = b.load(kept)
                b.store(b.select(b.icmp_signed(sign, keys, old), keys, old), kept)
        ends = []
        for feature in range(2):
            every_other = vector(I32)(list(range(feature, 2 * LANES, 2)))
            for name, (_, kept) in zip(("smin", "smax"), best, strict=True):
                keys = b.load(kept)
                ends.append(_fold(b, b.shuffle_vector(keys, keys, every_other), name))
        return context.make_tuple(b, signature.return_type, ends)

    return types.UniTuple(types.int32, 4)(words, types.uint64, types.uint64), generate


def _tally(weighted: bool) -> Callable:
    """The code of `tally`, or of `tally_weighted`."""

    def generate(context, b, signature, args):
        words, target, *weight, start, stop, cut0, cut1 = args
        arrays = [words, target, *weight]
        zero = vector(I64)([0] * LANES)
        sides = [
            (rise, _limit(b, cut), [cgutils.alloca_once_value(b, zero) for _ in "ws"])
            for rise, cut in ((32, cut0), (0, cut1))
        ]
        with _groups(b, start, stop) as (i, alive):
            group, y, *w = (
                _load(b, _at(context, b, kind, array, i))
                for kind, array in zip(signature.args, arrays, strict=False)
            )
            w = w[0] if weighted else vector(I64)([1] * LANES)
            parts = (w, b.mul(w, y) if weighted else y)
            for rise, limit, sums in sides:
                raised = b.shl(group, splat(b, I64(rise)))
                goes = b.and_(b.icmp_signed("<=", raised, limit), alive)
                for part, total in zip(parts, sums, strict=True):
                    b.store(b.add(b.load(total), b.select(goes, part, zero)), total)
        ends = [_fold(b, b.load(total), "add") for *_, sums in sides for total in sums]
        return context.make_tuple(b, signature.return_type, ends)

    return generate


_FOUR = types.UniTuple(types.int64, 4)
_ENDS = (types.uint64, types.uint64, types.int32, types.int32)


@intrinsic
def tally(typing, words, target, start, stop, cut0, cut1):
    """Number and target sum of rows `start:stop` up to cut 0 of feature 0; and 1, 1."""
    return _FOUR(words, target, *_ENDS), _tally(False)


@intrinsic
def tally_weighted(typing, words, target, weight, start, stop, cut0, cut1):
    """`tally` of rows that count `weight` times."""
    return _FOUR(words, target, weight, *_ENDS), _tally(True)


@intrinsic
def sift(typing, columns, source, end, left, right, rise, cut):
    """Move the group at `source`, of rows before `end`, to `left` on or up to `right`.

    columns: arrays that move together, words first; rise, cut: rows whose words, moved
    up by `rise` bits, have an upper key of at most `cut` go left. Returns how many do.
    Wants `SHUFFLE`.
    """

    def generate(context, b, signature, args):
        columns, source, end, left, right, rise, cut = args
        pairs = list(
            zip(signature.args[0], cgutils.unpack_tuple(b, columns), strict=True)
        )
        groups = [_load(b, _at(context, b, *pair, source)) for pair in pairs]
        rest = b.sub(end, source)
        rest = b.select(b.icmp_unsigned("<", rest, I64(LANES)), rest, I64(LANES))
        alive = b.icmp_unsigned("<", _NUMBERS, splat(b, rest))
        raised = b.shl(groups[0], splat(b, rise))
        goes = b.icmp_signed("<=", raised, _limit(b, cut))
        chosen = b.bitcast(b.and_(goes, alive), I8)
        moved = b.zext(call(b, "llvm.ctpop.i8", I8, chosen), I64)
        first = b.icmp_unsigned("<", _NUMBERS, splat(b, moved))
        second = b.and_(b.not_(first), alive)
        table = cgutils.global_constant(b.module, "bcrl.orders", _ORDERS)
        order = b.load(b.gep(table, [I64(0), b.zext(chosen, I64)]))
        order = b.bitcast(order, vector(I8))
        ends = ((left, first), (b.sub(b.add(right, I64(1)), rest), second))
        for pair, group in zip(pairs, groups, strict=True):
            width = group.type.element.width
            index = b.zext(order, group.type)
            packed = call(b, _PERMUTE[width], group.type, group, index)
            for start, lanes in ends:
                # Blended and stored whole: a masked store is slow to be read again.
                where = _at(context, b, *pair, start)
                whole = b.select(lanes, packed, _load(b, where))
                b.store(whole, where, align=width // 8)
        return moved

    places = [types.uint64] * 4
    return types.uint64(columns, *places, types.int64, types.int32), generate
