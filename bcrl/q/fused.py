"""DQN's update and forward pass compiled, a seed at a time: the CPU's way.

Computes what `bcrl.q.mlp` and `DQN`'s torch update compute with batched products, but
one seed's parameters stay in the cache from the batch to Adam, and no cost is paid by
the call. A seed's floats don't depend on the others nor on the number of threads.
Matrix products are SciPy's BLAS's, loaded here and kept to one thread by the caller.
A transition's bootstrap value is kept until the target network changes, so that a batch
asks the target only about transitions not drawn since.
"""

from __future__ import annotations

import numba
import numpy as np
import scipy.linalg.cython_blas  # noqa: F401, limits reach only what is loaded

FADED = np.float32(1e-30)
TOGETHER = 256  # rows that the target is asked about at a time, ahead of their use
_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")
#: For Adam's division and square root. An infinite weight may turn into one that is not
#: a number ("ninf"), and that stays one (no "nnan"): either is found.
_approximate = {"reassoc", "nsz", "arcp", "contract", "afn", "ninf"}


@_compiled
def row_times(row, weights, out):
    """row (in,) · weights (in, out), for which a call of BLAS is dear."""
    out[:] = np.float32(0.0)
    for k in range(len(row)):
        if row[k] != 0:  # as behind a ReLU that is off
            for j in range(len(out)):
                out[j] += row[k] * weights[k, j]


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
        if n == 1:
            row_times(before[0], weights, after[0])
        else:
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
def turn(matrix, out):
    """The transpose of `matrix` into `out`, which is written in sequence."""
    for j in range(matrix.shape[1]):
        column = out[j]
        for i in range(matrix.shape[0]):
            column[i] = matrix[i, j]


@_compiled
def backward(flat, sizes, x, work, slope, gradient, spare):
    """One seed's gradients into `gradient` (P,), from ∂loss/∂output `slope` (n, out).

    `work` holds the activations of `forward`, `spare` (3, n · widest) is overwritten.
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
            # slope · weightsᵀ as (weights · slopeᵀ)ᵀ: BLAS is twice as fast at it.
            aside = spare[1, : n * n_out].reshape(n_out, n)
            turn(slope, aside)
            turned = spare[2, : n * n_in].reshape(n_in, n)
            np.dot(weights, aside, turned)
            slope = spare[0, : n * n_in].reshape(n, n_in)
            turn(turned, slope)
            for row in range(n):
                for k in range(n_in):
                    on = before[row, k] > 0
                    slope[row, k] = slope[row, k] if on else np.float32(0.0)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=_approximate)
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
def renew(target, sizes, rows, bootstrap, known, places, layout, after, stale, work):
    """Make one seed's `bootstrap` max_a' (ϱ + base)(s') known at `places`.

    rows, bootstrap, known: the seed's part of `Replay`'s; after (n, d), stale (n,) and
    work are overwritten: up to n rows at a time are asked for.
    """
    d, n_actions = layout
    n, last = 0, len(places) - 1
    for i in range(len(places)):
        place = places[i]
        if not known[place]:
            known[place] = True
            after[n] = rows[place, d : 2 * d]
            stale[n] = place
            n += 1
        if n == len(stale) or (i == last and n > 0):
            values = forward(target, sizes, after[:n], work)
            for k in range(n):
                row = rows[stale[k]]
                best = values[k, 0] + row[2 * d]
                for a in range(1, n_actions):
                    best = max(best, values[k, a] + row[2 * d + a])
                bootstrap[stale[k]] = best
            n = 0


@_compiled
def renew_ahead(target, sizes, rows, bootstrap, known, held, places, layout):
    """`renew` for S seeds, at all `places` (T, S, B) of batches to come.

    In large products, and with a target's parameters loaded once. What is not among the
    first `held` rows yet is left out.
    """
    n_seeds, d = len(target), layout[0]
    work = np.empty(TOGETHER * sizes[1:].sum(), np.float32)
    after, stale = np.empty((TOGETHER, d), np.float32), np.empty(TOGETHER, np.int64)
    for s in range(n_seeds):
        there = places[:, s].copy().reshape(-1)
        there = there[there < held]
        renew(
            target[s],
            sizes,
            rows[s],
            bootstrap[s],
            known[s],
            there,
            layout,
            after,
            stale,
            work,
        )


@_compiled
def update(
    online,
    target,
    moments,
    sizes,
    rows,
    bootstrap,
    known,
    places,
    layout,
    constants,
    states,
    loss,
    ahead,
):
    """One DQN update of S seeds, in place; each one's mean loss goes to `loss` (S,).

    online, target (S, P); moments (2, S, P); rows (S, capacity, width), bootstrap and
    known (S, capacity) of `Replay`; places (S, B) rows of each seed's own; layout: d
    and A; constants: Adam's. While its parameters are in the cache, each network is
    asked at the state that comes next, states (S, d): `ahead` (S, A).
    """
    d, n_actions = layout
    beta1, beta2, rate, scale, eps = constants
    n_seeds, n = places.shape
    total, widest = sizes[1:].sum(), sizes.max()
    work = np.empty(n * total, np.float32)
    spare = np.empty((3, n * widest), np.float32)
    gradient = np.empty(online.shape[1], np.float32)
    x, after = np.empty((n, d), np.float32), np.empty((n, d), np.float32)
    stale, one = np.empty(n, np.int64), np.float32(1.0)
    slope = np.empty((n, n_actions), np.float32)
    end = 2 * d + n_actions
    for s in range(n_seeds):
        held, value, fresh, drawn = rows[s], bootstrap[s], known[s], places[s]
        renew(target[s], sizes, held, value, fresh, drawn, layout, after, stale, work)
        for b in range(n):
            x[b] = held[drawn[b], :d]
        values = forward(online[s], sizes, x, work)
        slope[:] = np.float32(0.0)
        total_loss = 0.0
        for b in range(n):
            row = held[drawn[b]]
            a = int(row[end + 2])
            y = row[end] + row[end + 1] * value[drawn[b]]
            error = values[b, a] - y
            clipped = one if error > one else -one if error < -one else error  # or nan
            slope[b, a] = clipped / np.float32(n)
            total_loss += clipped * (error - np.float32(0.5) * clipped)
        loss[s] = total_loss / n
        backward(online[s], sizes, x, work, slope, gradient, spare)
        first, second = moments[0, s], moments[1, s]
        adam(online[s], gradient, first, second, beta1, beta2, rate, scale, eps)
        ahead[s] = forward(online[s], sizes, states[s : s + 1], work)[0]
