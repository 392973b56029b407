"""Products of chosen rows and terms against NumPy; nothing else is written."""

import numpy as np
import pytest

from bcrl.q.networks.tiles import tiled_product

SHAPES = pytest.mark.parametrize(
    ("n_rows", "columns", "n_terms"),
    [(1, 1, 1), (8, 32, 5), (9, 33, 0), (13, 40, 7), (21, 8, 33), (128, 70, 128)],
)


def computed(n_rows, columns, n_terms, transposed=False, first=0):
    """The product, and NumPy's, of random rows and terms; the columns from `first`."""
    rng = np.random.default_rng(n_rows + columns)
    height, depth = 2 * n_rows, 2 * n_terms + 1
    rows = np.sort(rng.permutation(height)[:n_rows])
    terms = np.sort(rng.permutation(depth)[:n_terms])
    left = rng.standard_normal((height, depth)).astype(np.float32)
    right = rng.standard_normal((depth, columns)).astype(np.float32)
    expected = left[rows][:, terms].astype(float) @ right[terms]
    flat, steps = left.reshape(-1), (depth, 1)
    if transposed:
        flat, steps = left.T.copy().reshape(-1), (1, height)
    right = right[:, first:].copy()
    out = np.full((height, columns - first), np.float32(7.0))
    shape = (columns - first, rows, n_rows, terms, n_terms)
    tiled_product(out, *shape, flat, steps, right)
    assert (np.delete(out, rows, 0) == 7.0).all()
    return out[rows], expected[:, first:]


@SHAPES
def test_products_are_numpys(n_rows, columns, n_terms):
    found, expected = computed(n_rows, columns, n_terms)
    assert np.allclose(found, expected, atol=1e-4)
    assert np.array_equal(computed(n_rows, columns, n_terms, True)[0], found)


@SHAPES
def test_a_column_does_not_depend_on_the_others(n_rows, columns, n_terms):
    found, _ = computed(n_rows, columns, n_terms)
    for first in (columns // 2, columns - 1):
        alone, _ = computed(n_rows, columns, n_terms, first=first)
        assert np.array_equal(alone, found[:, first:])
