"""A deep kernel's network as compiled loops: inputs to where the kernel is a plain one, and slopes back.

Conventions as in :mod:`~torch_ekm.residual.sparse_gp.engine.numba_kernels`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from .numba_kernels import _A1, _A2, _A3, _COMMON, _I1, absorb_fleet, query_fleet

__all__ = ["absorb_fleet", "embed_fleet", "query_fleet"]


@njit(types.void(_I1, _A2, _A2, _A2, _A2, _A1, types.boolean, _A2, _A2, _A3), **_COMMON)
def embed_fleet(widths, network, log_lengthscale, shift, scale, x, with_slopes, z, embedded, slope):
    """``[z / L, net(z)]`` of one input per model, and ``(d net/dz)'``, see DeepKernel.

    Args:
        widths: of the layers, the input's first.
        network: weights and biases of each model, layer by layer.
        x: one model's after the other's, in its own units.
        z: in the learner's units ``(models, d)``.
        embedded, slope: results, ``(models, d + features)`` and, with slopes, ``(models, d, features)``.
    """
    B, d = z.shape
    widest, layers = 0, widths.shape[0] - 1
    for layer in range(widths.shape[0]):
        widest = max(widest, widths[layer])
    values, rows = np.zeros((2, widest)), d if with_slopes else 0
    slopes = np.zeros((2, rows, widest))
    for b in range(B):
        own, unit = min(b, network.shape[0] - 1), min(b, shift.shape[0] - 1)
        weights = network[own]
        for j in range(d):
            z[b, j] = (x[b * d + j] - shift[unit, j]) / scale[unit, j]
            embedded[b, j] = z[b, j] * math.exp(-log_lengthscale[own, j])
            values[0, j] = z[b, j]
        at, now = 0, 0
        for layer in range(layers):
            n_in, n_out, last = widths[layer], widths[layer + 1], layer == layers - 1
            old, new = values[now], values[1 - now]
            bias = at + n_in * n_out
            for j in range(n_out):
                new[j] = 0.0 if last else weights[bias + j]
            for i in range(n_in):
                a, row = old[i], weights[at + i * n_out : at + (i + 1) * n_out]
                for j in range(n_out):
                    new[j] += a * row[j]
            if not last:
                for j in range(n_out):
                    new[j] = math.tanh(new[j])
            for c in range(rows):
                before, after = slopes[now, c], slopes[1 - now, c]
                for j in range(n_out):
                    after[j] = weights[at + c * n_out + j] if layer == 0 else 0.0
                if layer > 0:
                    for i in range(n_in):
                        a, row = before[i], weights[at + i * n_out : at + (i + 1) * n_out]
                        for j in range(n_out):
                            after[j] += a * row[j]
                if not last:
                    for j in range(n_out):
                        after[j] *= 1.0 - new[j] * new[j]
            now, at = 1 - now, bias + (0 if last else n_out)
        for j in range(widths[layers]):
            embedded[b, d + j] = values[now, j]
            for c in range(rows):
                slope[b, c, j] = slopes[now, c, j]
