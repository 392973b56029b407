"""Matrix products in registers, of chosen rows and terms: what a batch leaves alive.

Behind a ReLU a third of a layer's units is off for a whole batch. Here a **tile** of a
few rows and columns is summed up over a list of terms. The order of a sum is the
list's, whatever the processor: a float depends neither on others nor on the tile.
"""

from itertools import chain

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils

from bcrl.common.compiling import cpu_features, instructions

_FEATURES = cpu_features()
#: Rows of a tile and floats per vector. With eight rows, the loop reads addresses from
#: the stack, and in some processes it then takes up to 2.4 times as long.
ROWS, LANES = 4, 16 if "+avx512f" in _FEATURES else 8 if "+avx2" in _FEATURES else 4
WIDTH = 2 * LANES  # columns of a tile
SQUARE = 8  # of the squares that `turn` transposes
I32, I64 = ir.IntType(32), ir.IntType(64)
FLOATS, NUMBERS = ir.VectorType(ir.FloatType(), LANES), ir.VectorType(I32, LANES)
ZEROS = FLOATS([0.0] * LANES)


def _tile(width: int):
    """An intrinsic: `multiply` for ROWS rows and `width` columns."""

    def generate(context, b, signature, args):
        def vectors(array, at):  # the addresses of a row's, from float `at` on
            places = [b.add(at, I64(v)) for v in range(0, width, LANES)]
            kind = FLOATS.as_pointer()
            return [b.bitcast(b.gep(array.data, [p]), kind) for p in places]

        out, rows, begin, last, column, terms, n_terms, a, across, along, right = (
            context.make_array(kind)(context, b, value)
            if isinstance(kind, types.Array)
            else value
            for kind, value in zip(signature.args, args, strict=True)
        )
        out_width, right_width = (b.extract_value(x.shape, 1) for x in (out, right))
        lefts, ends, sums = [], [], []
        for r in range(ROWS):  # after the last row, that one again
            number = b.add(begin, I64(r))
            number = b.select(b.icmp_signed("<", number, last), number, last)
            row = b.load(b.gep(rows.data, [number]))
            lefts.append(b.gep(a.data, [b.mul(row, across)]))
            ends += vectors(out, b.add(b.mul(row, out_width), column))
            starts = range(0, width, LANES)
            sums.append([cgutils.alloca_once_value(b, ZEROS) for _ in starts])
        kind = ir.FunctionType(FLOATS, [FLOATS] * 3)
        name = f"llvm.fmuladd.v{LANES}f32"
        fused = cgutils.get_or_insert_function(b.module, kind, name)
        with cgutils.for_range(b, n_terms) as loop:
            term = b.load(b.gep(terms.data, [loop.index]))
            step, at = b.mul(term, along), b.add(b.mul(term, right_width), column)
            others = [b.load(place, align=4) for place in vectors(right, at)]
            for left, totals in zip(lefts, sums, strict=True):
                factor = b.insert_element(ZEROS, b.load(b.gep(left, [step])), I32(0))
                factor = b.shuffle_vector(factor, ZEROS, NUMBERS([0] * LANES))
                for other, total in zip(others, totals, strict=True):
                    more = b.call(fused, (factor, other, b.load(total)))
                    b.store(more, total)
        for end, total in zip(ends, chain.from_iterable(sums), strict=True):
            b.store(b.load(total), end, align=4)
        return context.get_dummy_value()

    @instructions
    def tile(
        typing, out, rows, begin, last, column, terms, n_terms, a, across, along, right
    ):
        n = types.intp
        return types.void(out, rows, n, n, n, terms, n, a, n, n, right), generate

    return tile


_wide, _narrow = _tile(WIDTH), _tile(LANES)


@njit
def multiply(out, columns, rows, n_rows, terms, n_terms, a, across, along, right):
    """out[r] = Σ_t a[r · across + t · along] · right[t] for listed rows r and terms t.

    The first `columns` columns are computed; what is written behind a row's end, up to
    WIDTH, is overwritten by the rows below, if they are listed.
    """
    for begin in range(0, n_rows, ROWS):
        for column in range((columns - 1) // WIDTH * WIDTH, -1, -WIDTH):
            place, factors = (begin, n_rows - 1, column), (a, across, along, right)
            if columns - column > LANES:
                _wide(out, rows, *place, terms, n_terms, *factors)
            else:
                _narrow(out, rows, *place, terms, n_terms, *factors)


@instructions
def turn(typing, slopes, units, turned, row, column):
    """Zero a square of slopes where their units are off, and write it transposed."""

    def generate(context, b, signature, args):
        *arrays, row, column = args
        slopes, units, turned = (
            context.make_array(kind)(context, b, value)
            for kind, value in zip(signature.args, arrays, strict=False)
        )
        lanes = ir.VectorType(ir.FloatType(), SQUARE)
        order, zero = ir.VectorType(I32, SQUARE), lanes([0.0] * SQUARE)

        def place(array, r, c):
            at = b.add(b.mul(r, b.extract_value(array.shape, 1)), c)
            return b.bitcast(b.gep(array.data, [at]), lanes.as_pointer())

        block = []
        for r in range(SQUARE):
            k = b.add(row, I64(r))
            value = b.load(place(slopes, k, column), align=4)
            on = b.fcmp_ordered(">", b.load(place(units, k, column), align=4), zero)
            block.append(b.select(on, value, zero))
            b.store(block[r], place(slopes, k, column), align=4)
        half = SQUARE // 2
        while half:  # halves of smaller and smaller squares change places
            low = [i if not i & half else i - half + SQUARE for i in range(SQUARE)]
            high = [i + half if not i & half else i + SQUARE for i in range(SQUARE)]
            for r in range(SQUARE):
                if not r & half:
                    pair = block[r], block[r + half]
                    block[r] = b.shuffle_vector(*pair, order(low))
                    block[r + half] = b.shuffle_vector(*pair, order(high))
            half //= 2
        for r in range(SQUARE):
            b.store(block[r], place(turned, b.add(column, I64(r)), row), align=4)
        return context.get_dummy_value()

    n = types.intp
    return types.void(slopes, units, turned, n, n), generate
