"""DQN's update and forward pass compiled, a seed at a time: the CPU's way.

The same as `mlp` and `DQN`'s torch update, but a seed's parameters stay in the cache,
and units that are off for a whole batch are left out of the products (`tiles`). A
layer's parameters, weights (in, out) and then biases, are one matrix (in + 1, out): the
input of a layer has a row of ones.
"""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from bcrl.common.compiling import kept
from bcrl.q.networks.tiles import SQUARE, WIDTH, multiply, turn

FADED = 1e-30  # moments up to this size become 0: denormal numbers are slow
#: For Adam's division and square root. An infinite weight may turn into one that is not
#: a number ("ninf"), and that stays one (no "nnan"): either is found.
_FAST = {"reassoc", "nsz", "arcp", "contract", "afn", "ninf"}
_BLOCK = 64  # floats that every processor's vectors divide
_AHEAD = 64  # rows per forward pass of the target network in `renew_ahead`
_compiled = numba.njit(nogil=True, error_model="numpy")
_compiled_fast = numba.njit(nogil=True, error_model="numpy", fastmath=_FAST)
_entry_point = kept(nogil=True, error_model="numpy")


class Room(NamedTuple):
    """What passes of n inputs through L layers write, with room for the last tiles."""

    units: NDArray[np.float32]  # (L + 1, widest, n): inputs, activations, outputs, ones
    slopes: NDArray[np.float32]  # the same of ∂loss/∂(what a ReLU is given)
    turned: NDArray[np.float32]  # (n, widest): one layer's slopes, transposed
    gradient: NDArray[np.float32]  # of one layer's parameters, flat
    alive: NDArray[np.int64]  # (L, widest + 1): units on in some column, then the ones
    n_alive: NDArray[np.int64]  # (L,): how many are on
    all: NDArray[np.int64]  # (widest or n,): all units of a layer, or columns


@_compiled
def space(sizes, n):
    layers, widest, wide = len(sizes), sizes.max(), n + WIDTH
    return Room(
        np.zeros((layers, widest + SQUARE, wide), np.float32),
        np.zeros((layers, widest + SQUARE, wide), np.float32),
        np.zeros((n + SQUARE, widest + WIDTH), np.float32),
        np.empty((widest + 1) * widest + WIDTH, np.float32),
        np.zeros((layers, widest + 1), np.int64),
        np.zeros(layers, np.int64),
        np.arange(max(n, widest)),
    )


@_compiled
def _relu(units, n_units, n, alive):
    """Put a layer's units through a ReLU; list those on in some column, count them."""
    on, zero = 0, np.float32(0.0)
    for k in range(n_units):
        some = 0  # integers, unlike floats, are taken together in vectors
        for b in range(n):
            positive = units[k, b] > zero
            some |= int(positive)
            units[k, b] = units[k, b] if positive else zero
        alive[on] = k
        on += some
    return on


@_compiled
def forward(flat, sizes, room, n):
    """Outputs (n_out, n) of one seed's network at the n inputs in room.units[0]."""
    at, last = 0, len(sizes) - 2
    for layer in range(last + 1):
        n_in, n_out = sizes[layer], sizes[layer + 1]
        before, after = room.units[layer], room.units[layer + 1]
        alive, m = room.alive[layer], n_in
        alive[:n_in] = room.all[:n_in]
        if layer:
            m = _relu(before, n_in, n, alive)
        before[n_in], alive[m], room.n_alive[layer] = np.float32(1.0), n_in, m
        factors = (alive, m + 1, flat[at:], 1, n_out, before)
        multiply(after, n, room.all, n_out, *factors)
        at += (n_in + 1) * n_out
    return room.units[last + 1]


@_compiled_fast
def _adam(parameters, first, second, gradient, adam):
    """`step_of_adam` for arrays whose length is a multiple of _BLOCK."""
    zero, least = np.float32(0.0), np.float32(FADED)
    rest1, rest2 = np.float32(1.0 - adam[0]), np.float32(1.0 - adam[1])
    beta1, beta2 = np.float32(adam[0]), np.float32(adam[1])
    rate, scale, eps = np.float32(adam[2]), np.float32(adam[3]), np.float32(adam[4])
    for i in range(len(parameters)):
        g = gradient[i]
        m = beta1 * first[i] + rest1 * g
        v = beta2 * second[i] + rest2 * g * g
        m = zero if abs(m) <= least else m
        v = zero if v <= least else v
        first[i], second[i] = m, v
        parameters[i] -= rate * m / (np.sqrt(v) * scale + eps)


@_compiled
def step_of_adam(parameters, first, second, gradient, adam):
    """Adam's step (Kingma and Ba 2015, algorithm 1) on arrays (P,), in place."""
    n, whole = len(parameters), len(parameters) // _BLOCK * _BLOCK
    _adam(parameters[:whole], first[:whole], second[:whole], gradient, adam)
    if whole < n:  # the last floats are rounded like the others, by the same vectors
        rest = np.zeros((4, _BLOCK), np.float32)
        arrays = parameters, first, second, gradient
        for i in range(4):
            rest[i, : n - whole] = arrays[i][whole:n]
        _adam(rest[0], rest[1], rest[2], rest[3], adam)
        for i in range(3):
            arrays[i][whole:] = rest[i, : n - whole]


@_compiled
def _mask_and_turn(slopes, units, n_units, n, turned):
    """Zero the slopes where their units are off; also transpose them."""
    for k in range(0, n_units, SQUARE):
        for b in range(0, n, SQUARE):
            turn(slopes, units, turned, k, b)


@_compiled
def backward(flat, first, second, sizes, room, n, adam):
    """A step of Adam on one seed's network (P,), after `forward` at n inputs.

    room.turned holds ∂loss/∂output, and so does the last of room.slopes.
    """
    at, last = len(flat), len(sizes) - 2
    above, n_above = room.all, sizes[last + 1]
    for layer in range(last, -1, -1):
        n_in, n_out = sizes[layer], sizes[layer + 1]
        end, at = at, at - (n_in + 1) * n_out
        before, alive, m = room.units[layer], room.alive[layer], room.n_alive[layer]
        slopes, below = room.slopes[layer + 1], room.slopes[layer]
        if layer:  # through the weights as they were in `forward`
            factors = (above, n_above, flat[at:end], n_out, 1, slopes)
            multiply(below, n, alive, m, *factors)
        factors = (room.all, n, before.reshape(-1), before.shape[1], 1, room.turned)
        gradient = room.gradient[: end - at].reshape(n_in + 1, n_out)
        multiply(gradient, n_out, alive, m + 1, *factors)
        passed = 0
        for k in range(n_in):
            if alive[passed] == k:
                passed += 1
            else:
                gradient[k] = np.float32(0.0)
        own = flat[at:end], first[at:end], second[at:end]
        step_of_adam(*own, room.gradient, adam)
        if layer:
            _mask_and_turn(below, before, n_in, n, room.turned)
        above, n_above = alive, m


@_compiled
def _row_times(row, weights, out):
    """row (in,) · weights (in, out); a separate function, so that it is vectorised."""
    out[:] = np.float32(0.0)
    for k in range(len(row)):
        if row[k] != 0:  # as behind a ReLU that is off
            for j in range(len(out)):
                out[j] += row[k] * weights[k, j]


@_compiled
def _outputs_at_one(flat, sizes, state, row, out):
    """Outputs at one state (d,), too little for tiles; `row`, `out`: the widest + 1."""
    at, last = 0, len(sizes) - 2
    row[: sizes[0]] = state
    for layer in range(last + 1):
        n_in, n_out = sizes[layer], sizes[layer + 1]
        end = at + (n_in + 1) * n_out
        row[n_in] = np.float32(1.0)
        weights = flat[at:end].reshape(n_in + 1, n_out)
        _row_times(row[: n_in + 1], weights, out[:n_out])
        if layer < last:
            row[:n_out] = np.maximum(out[:n_out], np.float32(0.0))
        at = end


@_entry_point
def outputs(flat, sizes, x):
    """Outputs (S, n, out) of S networks, parameters (S, P), at x (S, n, in)."""
    (n_seeds, n, d), n_out = x.shape, sizes[-1]
    out, room = np.empty((n_seeds, n, n_out), np.float32), space(sizes, n)
    row = np.empty(sizes.max() + 1, np.float32)
    values = np.empty_like(row)  # in separate memory, so that loops are vectorised
    for s in range(n_seeds):
        if n == 1:
            _outputs_at_one(flat[s], sizes, x[s, 0], row, values)
            out[s, 0] = values[:n_out]
        else:
            room.units[0, :d, :n] = x[s].T
            out[s] = forward(flat[s], sizes, room, n)[:n_out, :n].T
    return out


@_compiled
def renew(target, sizes, rows, bootstrap, valid, indices, layout, stale, room):
    """Make max_a' (ϱ + base)(s') valid at `indices`, up to len(stale) at a time."""
    d, n_actions = layout
    n, last = 0, len(indices) - 1
    for i, place in enumerate(indices):
        if not valid[place]:
            valid[place] = True
            for k in range(d):
                room.units[0, k, n] = rows[place, d + k]
            stale[n] = place
            n += 1
        if n == len(stale) or (i == last and n > 0):
            values = forward(target, sizes, room, n)
            for k in range(n):
                row = rows[stale[k]]
                best = values[0, k] + row[2 * d]
                for a in range(1, n_actions):
                    best = max(best, values[a, k] + row[2 * d + a])
                bootstrap[stale[k]] = best
            n = 0


@_entry_point
def renew_ahead(target, sizes, replay, held, indices, layout):
    """`renew` for S seeds at all `indices` (T, S, B) below `held`: in larger passes."""
    rows, bootstrap, valid = replay
    room, stale = space(sizes, _AHEAD), np.empty(_AHEAD, np.int64)
    for s in range(len(target)):
        there = indices[:, s].copy().reshape(-1)
        there = there[there < held]
        seed = (rows[s], bootstrap[s], valid[s])
        renew(target[s], sizes, *seed, there, layout, stale, room)


@_entry_point
def update(networks, sizes, replay, indices, layout, adam, states, loss, next_values):
    """One DQN update of S seeds, in place; the mean loss of each goes to `loss` (S,).

    networks: online and target parameters (S, P) and moments (2, S, P); replay: a
    `Replay`'s rows, bootstrap and valid; indices: (S, B); layout: d and A; adam: from
    `Adam.next_step`. `next_values` (S, A) gets the new outputs at `states` (S, d).
    """
    d, n_actions = layout
    online, target, moments = networks
    rows, bootstrap, valid = replay
    n_seeds, n = indices.shape
    room, stale, one = space(sizes, n), np.empty(n, np.int64), np.float32(1.0)
    row, answer = np.empty((2, sizes.max() + 1), np.float32)
    slopes, end = room.slopes[len(sizes) - 1], 2 * d + n_actions
    for s in range(n_seeds):
        held, value, fresh, drawn = rows[s], bootstrap[s], valid[s], indices[s]
        renew(target[s], sizes, held, value, fresh, drawn, layout, stale, room)
        for b, place in enumerate(drawn):
            for i in range(d):
                room.units[0, i, b] = held[place, i]
        values = forward(online[s], sizes, room, n)
        slopes[:n_actions] = np.float32(0.0)
        room.turned[:, :n_actions] = np.float32(0.0)
        total_loss = 0.0
        for b, place in enumerate(drawn):
            packed, a = held[place], int(held[place, end + 2])
            y = packed[end] + packed[end + 1] * value[place]
            error = values[a, b] - y
            clipped = one if error > one else -one if error < -one else error  # or nan
            room.turned[b, a] = slopes[a, b] = clipped / np.float32(n)
            total_loss += clipped * (error - np.float32(0.5) * clipped)
        loss[s] = total_loss / n
        backward(online[s], moments[0, s], moments[1, s], sizes, room, n, adam)
        _outputs_at_one(online[s], sizes, states[s], row, answer)
        next_values[s] = answer[:n_actions]
