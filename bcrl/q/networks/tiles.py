"""A matrix product of chosen rows and terms, summed in the processor's registers.

A third of the units behind a ReLU is off for a whole batch, and a library's product
can't leave them out. Here a *tile* of a few rows and columns is summed over a list of
terms, one after the other. A result depends neither on the tile nor on the processor's
vectors. `bench/README.md` compares this with plain loops and with BLAS.
"""

from __future__ import annotations

from collections.abc import Callable

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils, codegen
from numba.extending import intrinsic

#: Rows, vectors and floats per vector of a tile: as many sums as there are registers.
_ROWS, _VECTORS, _FLOATS = (
    (8, 2, 16) if "+avx512f" in codegen.get_host_cpu_features() else (4, 2, 8)
)
_NARROW = 8  # columns of the tile for what is left, or for few columns


def _tile(vectors: int, floats: int) -> Callable:
    """An intrinsic for _ROWS rows and vectors · floats columns of a product."""
    vector, i64 = ir.VectorType(ir.FloatType(), floats), ir.IntType(64)
    first_lane = ir.VectorType(ir.IntType(32), floats)([0] * floats)

    def generate(context, b, signature, args):
        out, left, right, rows, first_row, column, terms, n_terms, *strides = (
            context.make_array(kind)(context, b, value).data
            if isinstance(kind, types.Array)
            else value
            for kind, value in zip(signature.args, args, strict=True)
        )
        width, across, along = strides

        def vectors_at(array, row):
            start = b.add(b.mul(row, width), column)
            for v in range(vectors):
                place = b.gep(array, [b.add(start, i64(v * floats))])
                yield b.bitcast(place, vector.as_pointer())

        kind = ir.FunctionType(vector, [vector] * 3)
        name = f"llvm.fmuladd.v{floats}f32"
        fused = cgutils.get_or_insert_function(b.module, kind, name)
        chosen = [b.load(b.gep(rows, [b.add(first_row, i64(r))])) for r in range(_ROWS)]
        factors = [b.gep(left, [b.mul(row, across)]) for row in chosen]
        zero = vector([0.0] * floats)
        sums = [
            [cgutils.alloca_once_value(b, zero) for _ in range(vectors)] for _ in chosen
        ]
        with cgutils.for_range(b, n_terms) as loop:
            term = b.load(b.gep(terms, [loop.index]))
            others = [b.load(place, align=4) for place in vectors_at(right, term)]
            step = b.mul(term, along)
            for factor, row_sums in zip(factors, sums, strict=True):
                undefined, one = vector(ir.Undefined), b.load(b.gep(factor, [step]))
                one = b.insert_element(undefined, one, i64(0))
                same = b.shuffle_vector(one, undefined, first_lane)
                for other, total in zip(others, row_sums, strict=True):
                    b.store(b.call(fused, [same, other, b.load(total)]), total)
        for row, row_sums in zip(chosen, sums, strict=True):
            for place, total in zip(vectors_at(out, row), row_sums, strict=True):
                b.store(b.load(total), place, align=4)
        return context.get_dummy_value()

    @intrinsic
    def tile(
        typing, out, left, right, rows, first, column, terms, n, width, across, along
    ):
        i = types.intp
        arguments = (out, left, right, rows, i, i, terms, i, i, i, i)
        return types.void(*arguments), generate

    return tile


_wide, _narrow = _tile(_VECTORS, _FLOATS), _tile(1, _NARROW)


@njit(nogil=True, error_model="numpy", fastmath={"contract"})
def tiled_product(out, columns, rows, n_rows, terms, n_terms, left, steps, right):
    """out[r, :columns] = Σ_t left[r · steps[0] + t · steps[1]] · right[t, :columns].

    out (…, width) and right (…, width) are C-contiguous and have as many columns, left
    is flat. The first `n_rows` of `rows` are computed, and the sums are taken over the
    first `n_terms` of `terms` in their order.
    """
    width, (across, along) = out.shape[1], steps
    if n_rows < _ROWS or columns < _NARROW:
        for i in range(n_rows):
            r = rows[i]
            out[r, :columns] = 0
            for k in range(n_terms):
                t = terms[k]
                factor = left[r * across + t * along]
                for c in range(columns):
                    out[r, c] += factor * right[t, c]
        return
    strides = width, across, along
    for i in range(0, n_rows, _ROWS):
        first = min(i, n_rows - _ROWS)  # the last tiles overlap the ones before
        column = 0
        while column < columns:
            if columns - column >= _VECTORS * _FLOATS:
                _wide(out, left, right, rows, first, column, terms, n_terms, *strides)
                column += _VECTORS * _FLOATS
            else:
                last = min(column, columns - _NARROW)
                _narrow(out, left, right, rows, first, last, terms, n_terms, *strides)
                column += _NARROW
