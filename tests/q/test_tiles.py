"""Products of chosen rows and terms against NumPy, and that nothing else is written."""

import numpy as np
import pytest
from numba import njit

from bcrl.q.networks import tiles

SHAPES = pytest.mark.parametrize(
    ("n_rows", "columns", "n_terms"),
    [(1, 1, 1), (8, 32, 5), (9, 33, 0), (13, 40, 7), (21, 8, 33), (128, 70, 128)],
)


@njit
def compiled(finish, to, columns, rows, terms, a, across, along, right):
    """One of the products, as `bcrl.q.networks.cpu` calls it."""
    given = (columns, rows, len(rows), terms, len(terms), a, across, along, right)
    if finish == 0:
        tiles.product((to[0],), *given)
    elif finish == 1:
        tiles.product_relu((to[0], to[3]), *given)
    else:
        tiles.product_adam((to[0], to[1], to[2], *CONSTANTS), *given)


CONSTANTS = (0.9, 0.1, 0.999, 0.001, 0.01, 1.5, 1e-8)


class Case:
    """Factors, the rows and terms of a product, and what it writes to."""

    def __init__(self, n_rows, columns, n_terms):
        rng = np.random.default_rng(n_rows + columns)
        height, depth = 2 * n_rows, 2 * n_terms + 1
        self.rows = np.sort(rng.permutation(height)[:n_rows])
        self.terms = np.sort(rng.permutation(depth)[:n_terms])
        self.a = rng.standard_normal((height, depth)).astype(np.float32)
        self.columns = columns
        self.right = np.zeros((depth, columns + tiles.WIDTH), np.float32)
        self.right[:, :columns] = rng.standard_normal((depth, columns))
        self.to = [rng.random((height, columns)).astype(np.float32) for _ in range(3)]
        self.some = np.zeros(height, np.int32)
        chosen = self.a[self.rows][:, self.terms].astype(float)
        self.expected = chosen @ self.right[self.terms, :columns]

    def run(self, finish, turned=False):
        """What the arrays are afterwards; turned: the left factor lies transposed."""
        to = [array.copy() for array in self.to]
        height, depth = self.a.shape
        a, steps = self.a.reshape(-1), (depth, 1)
        if turned:
            a, steps = self.a.T.copy().reshape(-1), (1, height)
        given = (self.columns, self.rows, self.terms, a, *steps, self.right)
        compiled(finish, (*to, self.some), *given)
        others = np.setdiff1d(np.arange(height), self.rows)
        for after, before in zip(to, self.to, strict=True):
            assert np.array_equal(after[others], before[others])
        return [array[self.rows] for array in to]


@SHAPES
def test_products_are_numpys(n_rows, columns, n_terms):
    case = Case(n_rows, columns, n_terms)
    found, *_ = case.run(0)
    assert np.allclose(found, case.expected, atol=1e-4)
    assert np.array_equal(case.run(0, turned=True)[0], found)


@SHAPES
def test_a_column_is_the_same_in_any_company(n_rows, columns, n_terms):
    case = Case(n_rows, columns, n_terms)
    found, *_ = case.run(0)
    for column in (0, columns // 2, columns - 1):
        alone = Case(n_rows, columns, n_terms)
        alone.columns = 1
        alone.to = [np.zeros((2 * n_rows, 1), np.float32)] * 3
        alone.right = np.roll(alone.right, -column, 1)
        assert np.array_equal(alone.run(0)[0][:, 0], found[:, column])


@SHAPES
def test_relu_says_which_rows_are_on(n_rows, columns, n_terms):
    case = Case(n_rows, columns, n_terms)
    case.a[case.rows[::3]] = -np.abs(case.a[case.rows[::3]])
    case.right = np.abs(case.right)
    plain, *_ = case.run(0)
    found, *_ = case.run(1)
    assert np.array_equal(found, np.maximum(plain, 0.0))
    assert np.array_equal(case.some[case.rows] != 0, (plain > 0).any(1))
    assert not case.some[np.setdiff1d(np.arange(2 * n_rows), case.rows)].any()


@SHAPES
def test_adams_step_is_made_where_the_gradient_is(n_rows, columns, n_terms):
    case = Case(n_rows, columns, n_terms)
    parameters, first, second = (x[case.rows].astype(float) for x in case.to)
    found = case.run(2)
    beta1, rest1, beta2, rest2, rate, scale, eps = CONSTANTS
    first = beta1 * first + rest1 * case.expected
    second = beta2 * second + rest2 * case.expected**2
    moved = parameters - rate * first / (np.sqrt(second) * scale + eps)
    for ours, expected in zip(found, (moved, first, second), strict=True):
        assert np.allclose(ours, expected, rtol=1e-4, atol=1e-4)


def test_without_gradient_and_moments_no_parameter_moves():
    case = Case(9, 33, 4)
    case.to[1][:, ::2] = case.to[2][:, ::2] = 0.0
    case.right[:, ::2] = 0.0
    parameters, first, second = case.run(2)
    before = case.to[0][case.rows]
    assert np.array_equal(parameters[:, ::2], before[:, ::2])
    assert not first[:, ::2].any() and not second[:, ::2].any()
    assert (parameters[:, 1::2] != before[:, 1::2]).all()


@njit
def turned(slopes, units):
    out = np.full(slopes.shape[::-1], np.float32(7.0))
    for row in range(0, slopes.shape[0], tiles.LANES):
        for column in range(0, slopes.shape[1], tiles.LANES):
            tiles.turn(slopes, units, out, row, column)
    return out


def test_slopes_are_transposed_and_zero_where_units_are_off():
    rng = np.random.default_rng(0)
    slopes, units = rng.standard_normal((2, 48, 32)).astype(np.float32)
    units[units < 0] = 0.0
    expected = np.where(units > 0, slopes, 0.0)
    out = turned(slopes, units)
    assert np.array_equal(slopes, expected) and np.array_equal(out, expected.T)
