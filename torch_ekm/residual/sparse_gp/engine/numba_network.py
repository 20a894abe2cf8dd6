"""A deep kernel's network as compiled loops for one model, see :class:`~torch_ekm.residual.DeepKernel`."""

from __future__ import annotations

import numpy as np
from numba import njit, types

from .numba_math import A1, A2, I1, INNER, INT, add_products, exp, matrix_at, transposed, vector_at


@njit(types.void(I1, I1, INT, A1), **INNER)
def network(widths, weights, own, values):
    """A deep kernel's ``net(z)`` at the end of ``values``, which begins with z and holds each layer.

    Args:
        widths: of the layers, the input's first.
        weights: addresses of weights and biases, layer by layer, of one model after the other's.
        own: which model's.
    """
    at, layers = 0, widths.shape[0] - 1
    for layer in range(layers):
        n_in, n_out, last = widths[layer], widths[layer + 1], layer == layers - 1
        W = matrix_at(weights[2 * layer], own, n_in, n_out)
        new, old = values[at + n_in : at + n_in + n_out], values[at : at + n_in]
        for j in range(n_out):
            new[j] = 0.0
        if not last:
            bias = vector_at(weights[2 * layer + 1], own, n_out)
            for j in range(n_out):
                new[j] = bias[j]
        for i in range(n_in):
            a, by = old[i], W[i]
            for j in range(n_out):
                new[j] += a * by[j]
        if not last:
            for j in range(n_out):
                new[j] = 1.0 - 2.0 / (exp(2.0 * new[j]) + 1.0)  # tanh
        at += n_in


@njit(types.void(I1, I1, INT, A1, A2), **INNER)
def network_slopes(widths, weights, own, values, slopes):
    """``slopes[:, :d] += slopes[:, d:] dnet/dz``, from the features back; d is the input's width."""
    layers, widest = widths.shape[0] - 1, 0
    for layer in range(layers + 1):
        widest = max(widest, widths[layer])
    at, both = values.shape[0] - widths[layers], np.empty((2, widest))
    for r in range(slopes.shape[0]):
        now, begin = 0, at
        for j in range(widths[layers]):
            both[0, j] = slopes[r, widths[0] + j]
        for layer in range(layers - 1, -1, -1):
            n_in, n_out = widths[layer], widths[layer + 1]
            W, old, new = matrix_at(weights[2 * layer], own, n_in, n_out), both[now], both[1 - now]
            begin -= n_in
            for i in range(n_in):
                total, line = 0.0, W[i]
                for j in range(n_out):
                    total += line[j] * old[j]
                new[i] = total
            if layer > 0:
                for i in range(n_in):
                    new[i] *= 1.0 - values[begin + i] * values[begin + i]
            now = 1 - now
        for j in range(widths[0]):
            slopes[r, j] += both[now, j]


@njit(types.void(I1, I1, INT, A2), **INNER)
def network_of_many(widths, weights, own, values):
    """:func:`network` of points, a row each."""
    at, layers, n = 0, widths.shape[0] - 1, values.shape[0]
    for layer in range(layers):
        n_in, n_out, last = widths[layer], widths[layer + 1], layer == layers - 1
        old, new = np.empty((n, n_in)), np.zeros((n, n_out))
        bias = vector_at(weights[2 * layer + 1], own, 0 if last else n_out)
        for i in range(n):
            for j in range(n_in):
                old[i, j] = values[i, at + j]
            for j in range(bias.shape[0]):
                new[i, j] = bias[j]
        at += n_in
        add_products(old, transposed(matrix_at(weights[2 * layer], own, n_in, n_out)), 1.0, new, False, False)
        for i in range(n):
            row, to = new[i], values[i, at : at + n_out]
            if not last:
                for j in range(n_out):
                    row[j] = 1.0 - 2.0 / (exp(2.0 * row[j]) + 1.0)  # tanh
            for j in range(n_out):
                to[j] = row[j]
