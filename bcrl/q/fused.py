"""DQN's update and forward pass compiled, a seed at a time: the CPU's way.

Computes what `bcrl.q.mlp` and `DQN`'s torch update compute with batched products, but
one seed's parameters stay in the cache from the batch to Adam, and no cost is paid by
the call. A seed's floats don't depend on the others nor on the number of threads.
Matrix products are SciPy's BLAS's, loaded here and kept to one thread by the caller.
"""

from __future__ import annotations

import numba
import numpy as np
import scipy.linalg.cython_blas  # noqa: F401, limits reach only what is loaded

FADED = np.float32(1e-30)
_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def forward(flat, sizes, x, work):
    """Outputs (n, out) of one seed's network at x (n, in); activations go to `work`."""
    n, at, to = x.shape[0], 0, 0
    before = x
    for layer in range(len(sizes) - 1):
        n_in, n_out = sizes[layer], sizes[layer + 1]
        weights = flat[at : at + n_in * n_out].reshape(n_in, n_out)
        at += n_in * n_out
        bias = flat[at : at + n_out]
        at += n_out
        after = work[to : to + n * n_out].reshape(n, n_out)
        to += n * n_out
        np.dot(before, weights, after)
        if layer < len(sizes) - 2:
            for row in range(n):
                for j in range(n_out):
                    value = after[row, j] + bias[j]
                    after[row, j] = value if value > 0 else np.float32(0.0)
        else:
            for row in range(n):
                for j in range(n_out):
                    after[row, j] += bias[j]
        before = after
    return before


@_compiled
def outputs(flat, sizes, x):
    """Outputs (S, n, out) of S networks, parameters (S, P), at x (S, n, in)."""
    n_seeds, n, _ = x.shape
    out = np.empty((n_seeds, n, sizes[-1]), np.float32)
    work = np.empty(n * sizes[1:].sum(), np.float32)
    for s in range(n_seeds):
        out[s] = forward(flat[s], sizes, x[s], work)
    return out


@_compiled
def backward(flat, sizes, x, work, slope, gradient, spare):
    """One seed's gradients into `gradient` (P,), from ∂loss/∂output `slope` (n, out).

    `work` holds the activations of `forward`, `spare` (2, n · widest) is overwritten.
    """
    n, last = x.shape[0], len(sizes) - 2
    at, to = len(flat), n * sizes[1:].sum()
    for layer in range(last, -1, -1):
        n_in, n_out = sizes[layer], sizes[layer + 1]
        at -= n_out
        bias = gradient[at : at + n_out]
        at -= n_in * n_out
        weights = flat[at : at + n_in * n_out].reshape(n_in, n_out)
        change = gradient[at : at + n_in * n_out].reshape(n_in, n_out)
        to -= n * n_out
        before = x
        if layer:
            before = work[to - n * n_in : to].reshape(n, n_in)
        bias[:] = np.float32(0.0)
        for row in range(n):
            for j in range(n_out):
                bias[j] += slope[row, j]
        np.dot(before.T, slope, change)
        if layer:
            onward = spare[layer % 2, : n * n_in].reshape(n, n_in)
            np.dot(slope, weights.T, onward)
            for row in range(n):
                for k in range(n_in):
                    on = before[row, k] > 0
                    onward[row, k] = onward[row, k] if on else np.float32(0.0)
            slope = onward


@_compiled
def adam(parameters, gradient, first, second, beta1, beta2, rate, scale, eps):
    """Adam on one seed's buffers (P,); `rate` and `scale` hold the bias corrections.

    Moments far too small to move a weight become 0: a dead unit's would fade into
    denormal numbers, on which processors are many times slower.
    """
    single = np.float32
    b1, c1, b2, c2 = single(beta1), single(1 - beta1), single(beta2), single(1 - beta2)
    rate, scale, eps, nothing = single(rate), single(scale), single(eps), single(0)
    for i in range(len(parameters)):
        g = gradient[i]
        m = b1 * first[i] + c1 * g
        v = b2 * second[i] + c2 * g * g
        m = m if abs(m) > FADED else nothing
        v = v if v > FADED else nothing
        first[i] = m
        second[i] = v
        parameters[i] -= rate * m / (np.sqrt(v) * scale + eps)


@_compiled
def update(
    online, target, moments, sizes, rows, places, layout, constants, states, loss, ahead
):
    """One DQN update of S seeds, in place; each one's mean loss goes to `loss` (S,).

    online, target (S, P); moments (2, S, P); rows (S, capacity, width) packed by
    `Replay`; places (S, B) rows of each seed's own; layout: d and A; constants: Adam's.
    While its parameters are in the cache, each network is asked at the state that comes
    next, states (S, d): `ahead` (S, A).
    """
    d, n_actions = layout
    beta1, beta2, rate, scale, eps = constants
    n_seeds, n = places.shape
    total, widest = sizes[1:].sum(), sizes.max()
    work = np.empty(n * total, np.float32)
    spare = np.empty((2, n * widest), np.float32)
    gradient = np.empty(online.shape[1], np.float32)
    x, after = np.empty((n, d), np.float32), np.empty((n, d), np.float32)
    y, one = np.empty(n, np.float32), np.float32(1.0)
    slope = np.empty((n, n_actions), np.float32)
    end = 2 * d + n_actions
    for s in range(n_seeds):
        for b in range(n):
            row = rows[s, places[s, b]]
            x[b] = row[:d]
            after[b] = row[d : 2 * d]
        values = forward(target[s], sizes, after, work)
        for b in range(n):
            row = rows[s, places[s, b]]
            best = values[b, 0] + row[2 * d]
            for a in range(1, n_actions):
                best = max(best, values[b, a] + row[2 * d + a])
            y[b] = row[end] + row[end + 1] * best
        values = forward(online[s], sizes, x, work)
        slope[:] = np.float32(0.0)
        total_loss = 0.0
        for b in range(n):
            a = int(rows[s, places[s, b], end + 2])
            error = values[b, a] - y[b]
            clipped = one if error > one else -one if error < -one else error  # or nan
            slope[b, a] = clipped / np.float32(n)
            total_loss += clipped * (error - np.float32(0.5) * clipped)
        loss[s] = total_loss / n
        backward(online[s], sizes, x, work, slope, gradient, spare)
        first, second = moments[0, s], moments[1, s]
        adam(online[s], gradient, first, second, beta1, beta2, rate, scale, eps)
        ahead[s] = forward(online[s], sizes, states[s : s + 1], work)[0]
