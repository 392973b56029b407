"""Products of chosen rows and terms against NumPy, and that nothing else is written."""

import numpy as np
import pytest
from numba import njit

from bcrl.q.networks.tiles import SQUARE, WIDTH, multiply, turn


@njit
def compiled(out, columns, rows, terms, a, across, along, right):
    """The product, as `bcrl.q.networks.cpu` calls it."""
    given = a, across, along, right
    multiply(out, columns, rows, len(rows), terms, len(terms), *given)


def factors(n_rows, columns, n_terms):
    """Rows, terms, the left factor, the right one, and their product."""
    rng = np.random.default_rng(n_rows + columns)
    height, depth = 2 * n_rows, 2 * n_terms + 1
    rows = np.sort(rng.permutation(height)[:n_rows])
    terms = np.sort(rng.permutation(depth)[:n_terms])
    a = rng.standard_normal((height, depth)).astype(np.float32)
    right = np.zeros((depth, columns + WIDTH), np.float32)
    right[:, :columns] = rng.standard_normal((depth, columns))
    chosen = a[rows][:, terms].astype(float)
    return rows, terms, a, right, chosen @ right[terms, :columns]


def run(rows, terms, a, right, columns, turned=False, room=WIDTH):
    """The listed rows; turned: the left factor lies transposed; room: behind a row."""
    height, depth = a.shape
    out = np.full((height + WIDTH, columns + room), np.nan, np.float32)
    left, steps = (a.T.copy(), (1, height)) if turned else (a, (depth, 1))
    compiled(out, columns, rows, terms, left.reshape(-1), *steps, right)
    if room:
        assert np.isnan(out[np.setdiff1d(np.arange(len(out)), rows)]).all()
    return out[rows, :columns]


@pytest.mark.parametrize(
    ("n_rows", "columns", "n_terms"),
    [(1, 1, 1), (8, 32, 5), (9, 33, 0), (13, 40, 7), (21, 8, 33), (128, 70, 128)],
)
def test_products_are_numpys(n_rows, columns, n_terms):
    *given, expected = factors(n_rows, columns, n_terms)
    found = run(*given, columns)
    assert np.allclose(found, expected, atol=1e-4)
    assert np.array_equal(run(*given, columns, turned=True), found)
    assert np.array_equal(run(*given, columns, room=0), found)
    rows, terms, a, right = given  # a column does not depend on the others
    for column in (0, columns // 2, columns - 1):
        alone = run(rows, terms, a, np.roll(right, -column, 1), 1)
        assert np.array_equal(alone[:, 0], found[:, column])


@njit
def turn_all(slopes, units, turned):
    for row in range(0, len(slopes), SQUARE):
        for column in range(0, slopes.shape[1], SQUARE):
            turn(slopes, units, turned, row, column)


def test_slopes_are_masked_and_transposed():
    rng = np.random.default_rng(0)
    slopes = rng.standard_normal((3 * SQUARE, 2 * SQUARE)).astype(np.float32)
    units = rng.standard_normal(slopes.shape).astype(np.float32)
    wanted, turned = np.where(units > 0, slopes, 0), np.zeros_like(slopes.T.copy())
    turn_all(slopes, units, turned)
    assert (slopes == wanted).all()
    assert (turned == wanted.T).all()
