"""Matrix products in registers, of chosen rows and terms: what a batch leaves alive.

Behind a ReLU a third of a layer's units is off for a whole batch. A library's product
can't leave them out; here a **tile** of a few rows and columns is summed up over a list
of terms, and its **finish** stores it, puts it through a ReLU, or makes the step of
Adam for which it is the gradient. The order of a sum is the list's, whatever the
processor's vectors: a float depends neither on the others nor on the tile.

The right factor is read beyond its last column, where WIDTH doesn't divide it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils, codegen, config
from numba.extending import intrinsic

_OURS = config.CPU_FEATURES  # type: ignore[attr-defined]
_FEATURES = set(
    (codegen.get_host_cpu_features() if _OURS is None else _OURS).split(",")
)
F32, I32, I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
#: Rows, vectors and floats a vector: as many sums as processors have registers for.
ROWS, VECTORS, LANES = (
    (8, 2, 16)
    if "+avx512f" in _FEATURES
    else (4, 2, 8)
    if "+avx2" in _FEATURES
    else (4, 2, 4)
)
WIDTH = VECTORS * LANES
NARROW = min(LANES, 8)  # floats of the vector for the last columns, or few ones
FADED = 1e-30
#: For Adam's division and square root. An infinite weight may turn into one that is not
#: a number ("ninf"), and that stays one (no "nnan"): either is found.
_FAST = ("reassoc", "nsz", "arcp", "contract", "afn", "ninf")


def _vector(element: ir.Type, lanes: int) -> ir.VectorType:
    return ir.VectorType(element, lanes)


def _splat(b: ir.IRBuilder, value: ir.Value, lanes: int) -> ir.Value:
    """A vector with `value` in every lane."""
    none = ir.Constant(_vector(value.type, lanes), ir.Undefined)
    one = b.insert_element(none, value, I32(0))
    return b.shuffle_vector(one, none, _vector(I32, lanes)([0] * lanes))


def _call(b: ir.IRBuilder, name: str, result: ir.Type, *args: ir.Value) -> ir.Value:
    """A call of one of LLVM's own functions."""
    kind = ir.FunctionType(result, [arg.type for arg in args])
    return b.call(cgutils.get_or_insert_function(b.module, kind, name), args)


def _constant(number: float, lanes: int) -> ir.Constant:
    return _vector(F32, lanes)([number] * lanes)


def _own(b: ir.IRBuilder, name: str, *args: ir.Value, **flags: Any) -> ir.Value:
    """LLVM's own function on vectors of floats."""
    kind = args[0].type
    function = cgutils.get_or_insert_function(
        b.module,
        ir.FunctionType(kind, [kind] * len(args)),
        f"llvm.{name}.v{kind.count}f32",
    )
    return b.call(function, args, **flags)


@dataclass(frozen=True)
class Place:
    """Where a vector of the tile belongs, in any array of the product's shape."""

    b: ir.IRBuilder
    at: ir.Value  # floats from the array's begin
    lanes: int
    inside: ir.Value | None = None  # a mask, if not all of its columns exist

    def _of(self, array: Any) -> ir.Value:
        start = self.b.gep(array.data, [self.at])
        return self.b.bitcast(start, _vector(F32, self.lanes).as_pointer())

    def load(self, array: Any) -> ir.Value:
        """The array's floats there."""
        if self.inside is None:
            return self.b.load(self._of(array), align=4)
        name, kind = f"llvm.masked.load.v{self.lanes}f32.p0", _vector(F32, self.lanes)
        given = (self._of(array), I32(4), self.inside, _constant(0.0, self.lanes))
        return _call(self.b, name, kind, *given)

    def store(self, array: Any, value: ir.Value) -> None:
        """Put floats into the array."""
        if self.inside is None:
            self.b.store(value, self._of(array), align=4)
        else:
            name = f"llvm.masked.store.v{self.lanes}f32.p0"
            given = (value, self._of(array), I32(4), self.inside)
            _call(self.b, name, ir.VoidType(), *given)


def _any(b: ir.IRBuilder, *vectors: ir.Value) -> ir.Value:
    """Whether some float of the vectors has a bit that is not 0."""
    lanes = vectors[0].type.count
    kind, number = _vector(I32, lanes), ir.IntType(lanes)
    bits = functools.reduce(b.or_, [b.bitcast(x, kind) for x in vectors])
    on = b.bitcast(b.icmp_signed("!=", bits, kind([0] * lanes)), number)
    return b.icmp_signed("!=", on, number(0))


def _store(b, row, places, totals, out) -> None:
    """A finish: the product itself."""
    for place, total in zip(places, totals, strict=True):
        place.store(out, total)


def _relu(b, row, places, totals, out, some) -> None:
    """A finish: what is positive; `some[row]` is set if some column is."""
    zero = _constant(0.0, places[0].lanes)
    totals = [b.select(b.fcmp_ordered(">", x, zero), x, zero) for x in totals]
    _store(b, row, places, totals, out)
    flag = b.gep(some.data, [row])
    b.store(b.or_(b.load(flag), b.zext(_any(b, *totals), I32)), flag)


def _adam(b, row, places, gradients, parameters, first, second, *constants) -> None:
    """A finish: Adam's step (Kingma and Ba 2015, algorithm 1).

    Moments far too small to move a weight become 0: a dead unit's would fade into
    denormal numbers, on which processors are many times slower. Where all is 0, nothing
    is done.
    """
    lanes = places[0].lanes
    zero, least = _constant(0.0, lanes), _constant(FADED, lanes)
    beta1, rest1, beta2, rest2, rate, scale, eps = (
        _splat(b, b.fptrunc(constant, F32), lanes) for constant in constants
    )

    def times(x: ir.Value, y: ir.Value) -> ir.Value:
        return b.fmul(x, y, flags=_FAST)

    def plus(x: ir.Value, y: ir.Value) -> ir.Value:
        return b.fadd(x, y, flags=_FAST)

    for place, gradient in zip(places, gradients, strict=True):
        m, v = place.load(first), place.load(second)
        with b.if_then(_any(b, m, v, gradient)):
            m = plus(times(beta1, m), times(rest1, gradient))
            v = plus(times(beta2, v), times(times(rest2, gradient), gradient))
            faded = b.fcmp_ordered("<=", _own(b, "fabs", m), least)
            m = b.select(faded, zero, m)
            v = b.select(b.fcmp_ordered("<=", v, least), zero, v)
            place.store(first, m)
            place.store(second, v)
            with b.if_then(_any(b, m)):
                root = _own(b, "sqrt", v, fastmath=_FAST)
                spread = plus(times(root, scale), eps)
                change = b.fdiv(times(rate, m), spread, flags=_FAST)
                moved = b.fsub(place.load(parameters), change, flags=_FAST)
                place.store(parameters, moved)


def _sums(b, chosen, column, terms, n_terms, a, across, along, right, size) -> list:
    """Where the tile's sums are: a list of vectors for each row."""
    vectors, lanes = size
    zero = _constant(0.0, lanes)
    sums = [
        [cgutils.alloca_once_value(b, zero) for _ in range(vectors)] for _ in chosen
    ]
    factors = [b.gep(a.data, [b.mul(row, across)]) for row in chosen]
    stride = b.extract_value(right.shape, 1)
    with cgutils.for_range(b, n_terms) as loop:
        term = b.load(b.gep(terms.data, [loop.index]))
        there, step = b.add(b.mul(term, stride), column), b.mul(term, along)
        others = [
            Place(b, b.add(there, I64(v * lanes)), lanes).load(right)
            for v in range(vectors)
        ]
        for factor, row_sums in zip(factors, sums, strict=True):
            one = _splat(b, b.load(b.gep(factor, [step])), lanes)
            for other, kept in zip(others, row_sums, strict=True):
                b.store(_own(b, "fmuladd", one, other, b.load(kept)), kept)
    return sums


def _tile(finish: Callable, *size: int) -> Callable:
    """An intrinsic: `product` of ROWS rows and a few columns, and its finish.

    size: vectors, and floats a vector.
    """
    vectors, lanes = size

    def generate(context, b, signature, args):
        def opened(kind: types.Type, value: ir.Value) -> Any:
            array = isinstance(kind, types.Array)
            return context.make_array(kind)(context, b, value) if array else value

        *kinds, to_kinds = signature.args
        rows, n_rows, begin, *rest = map(opened, kinds, args[:-1])
        to = list(map(opened, to_kinds, cgutils.unpack_tuple(b, args[-1])))
        numbers = [b.add(begin, I64(r)) for r in range(ROWS)]
        exist = [b.icmp_signed("<", number, n_rows) for number in numbers]
        chosen = [
            b.load(b.gep(rows.data, [b.select(there, number, begin)]))
            for number, there in zip(numbers, exist, strict=True)
        ]
        sums = _sums(b, chosen, *rest, size)  # type: ignore[call-arg]
        column, width = rest[0], b.extract_value(to[0].shape, 1)
        left = b.sub(width, column)

        def finish_row(r: int, masked: bool) -> None:
            places = []
            for v in range(vectors):
                at = b.add(b.mul(chosen[r], width), b.add(column, I64(v * lanes)))
                inside = None
                if masked:
                    own = _vector(I64, lanes)([v * lanes + i for i in range(lanes)])
                    inside = b.icmp_signed("<", own, _splat(b, left, lanes))
                places.append(Place(b, at, lanes, inside))
            finish(b, chosen[r], places, [b.load(kept) for kept in sums[r]], *to)

        whole = b.icmp_signed(">=", left, I64(vectors * lanes))
        with b.if_else(b.and_(whole, exist[-1])) as (usual, rest):
            with usual:
                for r in range(ROWS):
                    finish_row(r, masked=False)
            with rest:
                for r in range(ROWS):
                    with b.if_then(exist[r]):
                        finish_row(r, masked=True)
        return context.get_dummy_value()

    @intrinsic
    def tile(
        typing, rows, n_rows, begin, column, terms, n_terms, a, across, along, right, to
    ):
        n = types.intp
        return types.void(rows, n, n, n, terms, n, a, n, n, right, to), generate

    return tile


def _product(finish: Callable) -> Callable:
    """A compiled product with the given finish."""
    wide, narrow = _tile(finish, VECTORS, LANES), _tile(finish, 1, NARROW)

    @njit
    def product(to, columns, rows, n_rows, terms, n_terms, a, across, along, right):
        """Σ_t a[r · across + t · along] · right[t] for listed rows r and terms t.

        to: what the finish is given, first an array of the product's shape. Only the
        first `columns` columns are sure to be computed.
        """
        shape, factors = (terms, n_terms), (a, across, along, right)
        for begin in range(0, n_rows, ROWS):
            for column in range(0, columns, WIDTH):
                if columns - column > NARROW:
                    wide(rows, n_rows, begin, column, *shape, *factors, to)
                else:
                    narrow(rows, n_rows, begin, column, *shape, *factors, to)

    return product


product, product_relu, product_adam = map(_product, (_store, _relu, _adam))  # type: ignore[arg-type]


@intrinsic
def turn(typing, slopes, units, turned, row, column):
    """Zero LANES · LANES slopes where their units are off; also transpose them."""

    def generate(context, b, signature, args):
        *arrays, row, column = args
        slopes, units, turned = (
            context.make_array(kind)(context, b, value)
            for kind, value in zip(signature.args, arrays, strict=False)
        )
        stride, width = (b.extract_value(m.shape, 1) for m in (slopes, turned))
        block, zero, order = [], _constant(0.0, LANES), _vector(I32, LANES)
        for r in range(LANES):
            at = b.add(b.mul(b.add(row, I64(r)), stride), column)
            place = Place(b, at, LANES)
            on = b.fcmp_ordered(">", place.load(units), zero)
            block.append(b.select(on, place.load(slopes), zero))
            place.store(slopes, block[r])
        half = LANES // 2
        while half:  # halves of smaller and smaller squares change places
            low = [i if not i & half else i - half + LANES for i in range(LANES)]
            high = [i + half if not i & half else i + LANES for i in range(LANES)]
            for r in range(LANES):
                if not r & half:
                    pair = block[r], block[r + half]
                    block[r] = b.shuffle_vector(*pair, order(low))
                    block[r + half] = b.shuffle_vector(*pair, order(high))
            half //= 2
        for r in range(LANES):
            at = b.add(b.mul(b.add(column, I64(r)), width), row)
            Place(b, at, LANES).store(turned, block[r])
        return context.get_dummy_value()

    n = types.intp
    return types.void(slopes, units, turned, n, n), generate


@njit
def padded(n, size):
    """The next multiple of `size`."""
    return (n + size - 1) // size * size
