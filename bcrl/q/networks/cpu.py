"""DQN's update and forward pass in compiled loops, seed by seed: what a CPU runs.

`mlp` and the batched update in `bcrl.learning.dqn_update` compute the same with stacked
products in torch. Here the parameters of one seed stay in the processor's cache from
the forward pass to Adam's step, and a product leaves out every unit that its ReLU has
switched off. The result of a seed does not depend on the other seeds.

A layer's weights (n_in, n_out) and its biases (n_out,) form one matrix
(n_in + 1, n_out), because the input of each layer ends with a constant 1.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from bcrl.common.compiling import kept
from bcrl.q.networks.tiles import tiled_product

#: Magnitude below which Adam's moments become 0. The moments of a unit that is never on
#: would fade into denormal numbers, which processors handle many times more slowly.
FADED = np.float32(1e-30)
_AHEAD = 64  # rows per forward pass of the target network in `renew_ahead`

_compiled = numba.njit(nogil=True, error_model="numpy")
_entry_point = kept(nogil=True, error_model="numpy")


class Workspace(NamedTuple):
    """Arrays that passes of n inputs overwrite, for layers of widths n_0 … n_L."""

    units: NDArray[np.float32]  # (L + 1, widest + 1, n): inputs, activations, outputs
    slopes: NDArray[np.float32]  # (L + 1, widest, n): ∂loss/∂units
    transposed: NDArray[np.float32]  # (n · widest,): one layer's slopes as (n, n_out)
    on: NDArray[np.int64]  # (L, widest + 1): units that are on for some input, then 1
    n_on: NDArray[np.int64]  # (L,): how many are on
    all: NDArray[np.int64]  # (widest or n,): 0, 1, 2, …


@_compiled
def _workspace(sizes, n):
    widest, layers = sizes.max(), len(sizes)
    return Workspace(
        np.zeros((layers, widest + 1, n), np.float32),
        np.zeros((layers, widest, n), np.float32),
        np.empty(n * widest, np.float32),
        np.zeros((layers, widest + 1), np.int64),
        np.zeros(layers, np.int64),
        np.arange(max(n, widest)),
    )


@_compiled
def _forward(flat, sizes, work, n):
    """Outputs (n_L, n) of one seed's network at the first n inputs in work.units[0]."""
    end, last = 0, len(sizes) - 2
    for layer in range(last + 1):
        n_in, n_out = sizes[layer], sizes[layer + 1]
        begin, end = end, end + (n_in + 1) * n_out
        before, after, on = work.units[layer], work.units[layer + 1], work.on[layer]
        before[n_in] = np.float32(1.0)
        n_on = 0
        for k in range(n_in):
            on[n_on] = k
            n_on += layer == 0 or _relu(before[k, :n])
        on[n_on], work.n_on[layer] = n_in, n_on
        factors = (flat[begin:end], (1, n_out), before)
        tiled_product(after, n, work.all, n_out, on, n_on + 1, *factors)
    return work.units[last + 1]


@_compiled
def _relu(units):
    """Put max(x, 0) for each x into `units` (n,); whether any is positive."""
    zero, n_positive = np.float32(0.0), np.int32(0)
    for b in range(len(units)):
        positive = units[b] > zero
        units[b] = units[b] if positive else zero
        n_positive += positive
    return n_positive > 0


@_compiled
def _backward(flat, sizes, work, n, gradient):
    """Put ∂loss/∂parameters (P,) into `gradient`, after `_forward` at n inputs.

    The last of work.slopes holds ∂loss/∂output.
    """
    zero = np.float32(0.0)
    gradient[:] = zero
    begin, last = len(flat), len(sizes) - 2
    above, n_above = work.all, sizes[last + 1]
    for layer in range(last, -1, -1):
        n_in, n_out = sizes[layer], sizes[layer + 1]
        begin, end = begin - (n_in + 1) * n_out, begin
        before, on, n_on = work.units[layer], work.on[layer], work.n_on[layer]
        slopes, below = work.slopes[layer + 1], work.slopes[layer]
        by_input = work.transposed[: n * n_out].reshape(n, n_out)
        _transpose(slopes, by_input)
        factors = (before.reshape(-1), (before.shape[1], 1), by_input)
        rows = gradient[begin:end].reshape(n_in + 1, n_out)
        tiled_product(rows, n_out, on, n_on + 1, work.all, n, *factors)
        if layer:
            factors = (flat[begin:end], (n_out, 1), slopes)
            below[:n_in] = zero
            tiled_product(below, n, on, n_on, above, n_above, *factors)
            for i in range(n_on):
                k = on[i]
                for b in range(n):
                    below[k, b] = below[k, b] if before[k, b] > zero else zero
        above, n_above = on, n_on


@_compiled
def _transpose(matrix, out):
    """The first (m, n) of `matrix` as `out` (n, m), in blocks that fit the cache."""
    n, m = out.shape
    for begin in range(0, m, 16):
        for b in range(n):
            for j in range(begin, min(begin + 16, m)):
                out[b, j] = matrix[j, b]


@numba.njit(
    nogil=True,
    error_model="numpy",
    # No "nnan": an infinite weight may become NaN, and that must be noticed.
    fastmath={"reassoc", "nsz", "arcp", "contract", "afn", "ninf"},
)
def _adam_step(parameters, first, second, gradient, constants):
    """A step of Adam on arrays (P,), in place; constants: of `mlp.Adam.next_step`."""
    beta1, beta2, alpha, correction, epsilon = constants
    b1, b2 = np.float32(beta1), np.float32(beta2)
    rate, scale, eps = np.float32(alpha), np.float32(correction), np.float32(epsilon)
    rest1, rest2 = np.float32(1.0 - beta1), np.float32(1.0 - beta2)
    zero = np.float32(0.0)
    for i in range(len(parameters)):
        g = gradient[i]
        m = rest1 * g + b1 * first[i]
        v = b2 * second[i] + rest2 * g * g
        m = zero if abs(m) <= FADED else m
        v = zero if v <= FADED else v
        first[i], second[i] = m, v
        parameters[i] -= rate * m / (np.sqrt(v) * scale + eps)


@_compiled
def _outputs_at_one(flat, sizes, state, units, out):
    """Outputs of one seed's network at one state (d,), in out[:n_L].

    `units` and `out` have room for the widest layer and a constant 1.
    """
    end, last = 0, len(sizes) - 2
    units[: sizes[0]] = state
    for layer in range(last + 1):
        n_in, n_out = sizes[layer], sizes[layer + 1]
        begin, end = end, end + (n_in + 1) * n_out
        units[n_in] = np.float32(1.0)
        weights = flat[begin:end].reshape(n_in + 1, n_out)
        out[:n_out] = np.float32(0.0)
        for k in range(n_in + 1):
            if units[k] != np.float32(0.0):
                for j in range(n_out):
                    out[j] += units[k] * weights[k, j]
        if layer < last:
            for j in range(n_out):
                units[j] = max(out[j], np.float32(0.0))


@_entry_point
def outputs(flat, sizes, x):
    """Outputs (S, n, n_L) of S networks with parameters (S, P) at inputs (S, n, d)."""
    n_seeds, n, d = x.shape
    n_out = sizes[-1]
    out = np.empty((n_seeds, n, n_out), np.float32)
    work = _workspace(sizes, n)
    units, values = np.empty((2, sizes.max() + 1), np.float32)
    for s in range(n_seeds):
        if n == 1:
            _outputs_at_one(flat[s], sizes, x[s, 0], units, values)
            out[s, 0] = values[:n_out]
        else:
            for i in range(d):
                work.units[0, i] = x[s, :, i]
            found = _forward(flat[s], sizes, work, n)
            for a in range(n_out):
                out[s, :, a] = found[a]
    return out


@_compiled
def _fill_bootstrap(target, sizes, replay, indices, layout, todo, work):
    """Compute one seed's missing bootstrap values max_a' (ϱ + base)(s') at `indices`.

    replay: the seed's rows, bootstrap and valid; `todo` (n,) and `work`, made for n
    inputs, are overwritten, because the target is evaluated at up to n rows at once.
    """
    rows, bootstrap, valid = replay
    d, n_actions = layout
    n, last = 0, len(indices) - 1
    for i in range(len(indices)):
        index = indices[i]
        if not valid[index]:
            valid[index] = True
            work.units[0, :d, n] = rows[index, d : 2 * d]
            todo[n] = index
            n += 1
        if n == len(todo) or (i == last and n > 0):
            values = _forward(target, sizes, work, n)
            for b in range(n):
                base = rows[todo[b], 2 * d :]
                best = values[0, b] + base[0]
                for a in range(1, n_actions):
                    best = max(best, values[a, b] + base[a])
                bootstrap[todo[b]] = best
            n = 0


@_entry_point
def renew_ahead(target, sizes, replay, held, indices, layout):
    """Compute the bootstrap values of S seeds for batches `indices` (T, S, B) to come.

    This needs fewer and larger passes than batch by batch. Indices of rows that are not
    among the first `held` rows yet are left out.
    """
    work, todo = _workspace(sizes, _AHEAD), np.empty(_AHEAD, np.int64)
    rows, bootstrap, valid = replay
    for s in range(len(target)):
        batches = indices[:, s].copy().reshape(-1)
        batches = batches[batches < held]
        own = rows[s], bootstrap[s], valid[s]
        _fill_bootstrap(target[s], sizes, own, batches, layout, todo, work)


@_entry_point
def update(networks, sizes, replay, indices, layout, adam, states, loss, next_values):
    """Make one DQN update of S seeds in place and put each mean loss into `loss` (S,).

    networks: online and target parameters (S, P) and moments (2, S, P); replay: rows
    (S, capacity, width), bootstrap and valid (S, capacity) of a `Replay`; indices
    (S, B) of each seed's batch; layout: d and A; adam: from `Adam.next_step`. While the
    new parameters are in the cache, `next_values` (S, A) gets the network's outputs at
    the next states (S, d).
    """
    d, n_actions = layout
    online, target, moments = networks
    rows, bootstrap, valid = replay
    n_seeds, n = indices.shape
    work, todo = _workspace(sizes, n), np.empty(n, np.int64)
    units, values_at_one = np.empty((2, sizes.max() + 1), np.float32)
    gradient, one = np.empty_like(online[0]), np.float32(1.0)
    slopes, fixed = work.slopes[-1], 2 * d + n_actions
    for s in range(n_seeds):
        held, value, batch = rows[s], bootstrap[s], indices[s]
        own = held, value, valid[s]
        _fill_bootstrap(target[s], sizes, own, batch, layout, todo, work)
        for b in range(n):
            work.units[0, :d, b] = held[batch[b], :d]
        values = _forward(online[s], sizes, work, n)
        slopes[:] = np.float32(0.0)
        total_loss = 0.0
        for b in range(n):
            row = held[batch[b]]
            a = int(row[fixed + 2])
            y = row[fixed] + row[fixed + 1] * value[batch[b]]
            error = values[a, b] - y
            clipped = one if error > one else -one if error < -one else error  # or NaN
            slopes[a, b] = clipped / np.float32(n)
            total_loss += clipped * (error - np.float32(0.5) * clipped)
        loss[s] = total_loss / n
        _backward(online[s], sizes, work, n, gradient)
        _adam_step(online[s], moments[0, s], moments[1, s], gradient, adam)
        _outputs_at_one(online[s], sizes, states[s], units, values_at_one)
        next_values[s] = values_at_one[:n_actions]
