"""Compiled steps of Adam that bring a network's outputs near given values."""

import numpy as np

from bcrl.common.compiling import kept
from bcrl.q.networks.cpu import backward, forward, space


@kept(nogil=True, error_model="numpy")
def descend(flat, moments, sizes, x, y, indices, rates, done):
    """A step of Adam on one network (P,) for each batch of rows, (T, B) in `indices`.

    x (n, d) and y (n, A) are inputs and outputs in float32; the loss is the mean square
    over batch and actions. moments: (2, P); rates: (T,) learning rates; done: the steps
    of Adam before these.
    """
    n_steps, n = indices.shape
    d, n_actions = x.shape[1], y.shape[1]
    room, unit = space(sizes, n), np.float32(2.0 / (n * n_actions))
    slopes = room.slopes[len(sizes) - 1]
    for t in range(n_steps):
        for b in range(n):
            place = indices[t, b]
            for i in range(d):
                room.units[0, i, b] = x[place, i]
        values = forward(flat, sizes, room, n)
        for b in range(n):
            place = indices[t, b]
            for a in range(n_actions):
                slope = unit * (values[a, b] - y[place, a])
                room.turned[b, a] = slopes[a, b] = slope
        step = done + t + 1
        rate, scale = rates[t] / (1.0 - 0.9**step), 1.0 / np.sqrt(1.0 - 0.999**step)
        adam = (0.9, 0.999, rate, scale, 1e-8)
        backward(flat, moments[0], moments[1], sizes, room, n, adam)
