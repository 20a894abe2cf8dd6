"""Kernels and a deep kernel's network as compiled loops, see :mod:`~torch_ekm.residual.kernels`.

``p`` is a row of sizes and addresses, see :mod:`~torch_ekm.residual.sparse_gp.plan`, ``own`` the place of a
model's kernel. All arrays are C-contiguous and float64.
No call holds the GIL, none is parallel: numba and other libraries may not share one OpenMP runtime.

Loops over the last axis touch two or three arrays each: with more the compiler gives up proving that they
do not overlap, and does not vectorise. Entries are assigned one by one: an assignment of an array to a slice
can fail, and numba compiles the message with it, for seconds.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from ...kernels.stationary import LARGE
from .. import plan as P
from .numba_math import add_products, dot, exp, transposed
from .numba_memory import A1, A2, I1, INT, F, inner, integers_at, matrix_at
from .numba_memory import vector_at as at

#: what a kernel's ``kind`` means
SQUARED_EXPONENTIAL, MATERN32 = 0, 1
_FAR = 1e10  # squared scaled distance beyond which a kernel is 0


@inner(types.void(I1, INT, A2))
def network(p, own, values):
    """net(z) at the end of each row of ``values``, which begins with z and holds each layer."""
    begin, N = 0, values.shape[0]
    for layer in range(p[P.LAYERS]):
        n_in, n_out, _, bias_at, turned = integers_at(p[P.NETWORK], layer, 5)
        old, new, bias = np.empty((N, n_in)), np.zeros((N, n_out)), at(bias_at, own, n_out if bias_at else 0)
        for i in range(N):
            for j in range(n_in):
                old[i, j] = values[i, begin + j]
            for j in range(bias.shape[0]):
                new[i, j] = bias[j]
        begin += n_in
        add_products(old, matrix_at(turned, own, n_out, n_in), 1.0, new, False, False)
        for i in range(N):
            row, to = new[i], values[i, begin : begin + n_out]
            for j in range(bias.shape[0]):
                row[j] = 1.0 - 2.0 / (exp(2.0 * row[j]) + 1.0)  # tanh
            for j in range(n_out):
                to[j] = row[j]


@inner(types.void(I1, INT, A2, A2, A2, A1))
def network_back(p, own, values, by, to, gradient):
    """From derivatives by features those by z, which ``to`` gains, and by weights and biases.

    Args:
        values: of all layers, by point, or of one point for all rows of ``by``.
        to: rows that begin with z; none: not wanted.
        gradient: gains those by weights and biases before its last entries; empty: not wanted.
    """
    begin, end, N = values.shape[1] - by.shape[1], gradient.shape[0] - p[P.OUT], by.shape[0]
    for layer in range(p[P.LAYERS] - 1, -1, -1):
        n_in, n_out, weights, bias, _ = integers_at(p[P.NETWORK], layer, 5)
        begin -= n_in
        if gradient.shape[0] > 0:
            before, by_t = np.empty((n_in, N)), transposed(by)
            for i in range(N):
                for j in range(n_in):
                    before[j, i] = values[i, begin + j]
            end -= n_out if bias else 0
            for j in range(n_out if bias else 0):
                for i in range(N):
                    gradient[end + j] += by_t[j, i]
            end -= n_in * n_out
            own_part = gradient[end : end + n_in * n_out].reshape(n_in, n_out)
            add_products(before, by_t, 1.0, own_part, False, False)
        if layer > 0 or to.shape[0] > 0:
            new = np.zeros((N, n_in))
            add_products(by, matrix_at(weights, own, n_in, n_out), 1.0, new, False, False)
            for i in range(N if layer > 0 else 0):
                row, of = new[i], values[min(i, values.shape[0] - 1), begin : begin + n_in]
                for j in range(n_in):
                    row[j] *= 1.0 - of[j] * of[j]
            by = new
    for i in range(to.shape[0]):
        for j in range(p[P.IN]):
            to[i, j] += by[i, j]


@inner(types.void(I1, INT, A2, A2))
def embed(p, own, values, q):
    """``q``: points as the kernel sees them, in its lengthscales and with a network's features behind.

    A row of ``values`` begins with z and takes each layer of the network.
    """
    d, n_s, n = p[P.IN], p[P.IN] - p[P.ACTIONS], values.shape[1]
    log_lengthscale, by = at(p[P.LOG_LENGTHSCALE], own, n_s), np.ones(d)
    for j in range(n_s):
        by[j] = exp(-log_lengthscale[j])
    network(p, own, values)
    for i in range(values.shape[0]):
        for j in range(d):
            q[i, j] = values[i, j] * by[j]
        for j in range(d, q.shape[1]):
            q[i, j] = values[i, n - q.shape[1] + j]


@inner(types.void(I1, INT))
def turn_weights(p, own):
    """The network's weights the other way round, where products of rows find them."""
    for layer in range(p[P.LAYERS]):
        n_in, n_out, weights, _, turned = integers_at(p[P.NETWORK], layer, 5)
        W, to = matrix_at(weights, own, n_in, n_out), matrix_at(turned, own, n_out, n_in)
        for i in range(n_in):
            for j in range(n_out):
                to[j, i] = W[i, j]


@inner(types.void(INT, F, A1, A1, A1))
def _correlations(kind, variance, active, k, psi):
    """From squared scaled distances in ``k``: k and ``v psi`` at points in use, 0 elsewhere, see
    StationaryKernel."""
    n = k.shape[0]
    for i in range(n):
        k[i] = min(k[i], _FAR)
    if kind == SQUARED_EXPONENTIAL:
        for i in range(n):
            k[i] = variance * exp(-0.5 * k[i])
        for i in range(n):
            psi[i] = k[i]
    else:
        for i in range(n):
            k[i] = math.sqrt(3.0 * k[i])
        for i in range(n):
            psi[i] = variance * exp(-k[i])
        for i in range(n):
            k[i] = (1.0 + k[i]) * psi[i]
            psi[i] *= 3.0
    for i in range(n):
        k[i] = k[i] if active[i] != 0.0 else 0.0
        psi[i] = psi[i] if active[i] != 0.0 else 0.0


@inner(F(I1, INT, A1, A2, A1, A1, A1, A1))
def _of_distances(p, own, q, basis, active, k, psi, phi):
    """See :func:`kernel_row`; k begins as squared distances."""
    n, n_a, n_s = basis.shape[0], p[P.ACTIONS], q.shape[0] - p[P.ACTIONS]
    start = 0.0 if n_s > 0 else 1.0  # without a state it is a LinearKernel, which has a constant
    variance, log_action = math.exp(at(p[P.LOG_VARIANCE], own, 1)[0]), at(p[P.LOG_ACTION], own, n_a)
    _correlations(p[P.KIND], variance, active, k, psi)
    if n_a == 0:
        return variance
    norm, by = start, np.empty(n_a)
    for j in range(n_a):
        by[j] = q[n_s + j] * math.exp(log_action[j])
        norm += q[n_s + j] * by[j]
    for i in range(n):
        inner = start
        for j in range(n_a):
            inner += by[j] * basis[i, n_s + j]
        phi[i] = k[i]
        k[i] = phi[i] * inner if active[i] != 0.0 else 0.0
        psi[i] *= inner
    return variance * norm


@inner(F(I1, INT, A1, A2, A1, A1, A1, A1))
def kernel_row(p, own, q, basis, active, k, psi, phi):
    """k between q and the basis, both as the kernel sees them; returns k(q, q).

    ``psi`` and ``phi`` make the derivatives: ``dk/dq = psi (basis - q)`` of a state, ``phi Lambda basis`` of
    an action.
    """
    n_s = q.shape[0] - p[P.ACTIONS]
    for i in range(basis.shape[0]):
        d2, point = 0.0, basis[i]
        for j in range(n_s):
            u = point[j] - q[j]
            d2 += u * u
        k[i] = d2
    return _of_distances(p, own, q, basis, active, k, psi, phi)


@inner(types.void(I1, INT, A2, A2, A1, A2, A2, A2, A1))
def kernel_rows(p, own, q, basis, active, k, psi, phi, diagonal):
    """See :func:`kernel_row`, of many points q; their k(q, q) into ``diagonal``."""
    N, M, n_s = q.shape[0], basis.shape[0], q.shape[1] - p[P.ACTIONS]
    # about one of the points: far from 0 the difference of large squares would be all rounding
    a, c, a2, c2, far = np.empty((N, n_s)), np.empty((M, n_s)), np.zeros(N), np.zeros(M), 0.0
    for of, to, squares in ((q, a, a2), (basis, c, c2)):
        for i in range(of.shape[0]):
            for j in range(n_s):
                to[i, j] = of[i, j] - basis[0, j]
            squares[i] = dot(to[i], to[i], n_s)
            far = max(far, squares[i])
    if far > LARGE:  # that one, or others, lie far out: differences are exact
        for i in range(N):
            diagonal[i] = kernel_row(p, own, q[i], basis, active, k[i], psi[i], phi[i])
        return
    k[:, :] = 0.0
    add_products(a, c, -2.0, k, False, False)
    for i in range(N):
        for j in range(M):
            k[i, j] = max(k[i, j] + a2[i] + c2[j], 0.0)
        diagonal[i] = _of_distances(p, own, q[i], basis, active, k[i], psi[i], phi[i])


@inner(types.void(I1, INT, A1, A2, A1, A1, A2, A2))
def kernel_slopes(p, own, q, basis, psi, phi, left, out):
    """``out = left' dk/dq``, ``left (slots, rows)``."""
    n_a, log_action = p[P.ACTIONS], at(p[P.LOG_ACTION], own, p[P.ACTIONS])
    n_s, rows, u = q.shape[0] - n_a, out.shape[0], np.empty(q.shape[0])
    out[:] = 0.0
    for i in range(basis.shape[0]):
        if psi[i] == 0.0 and (n_a == 0 or phi[i] == 0.0):
            continue
        point, a = basis[i], psi[i]
        for j in range(n_s):
            u[j] = a * (point[j] - q[j])
        for j in range(n_s, n_s + n_a):
            u[j] = phi[i] * point[j]
        for r in range(rows):
            to, b = out[r], left[i, r]
            for j in range(u.shape[0]):
                to[j] += b * u[j]
    for j in range(n_a):
        lam = math.exp(log_action[j])
        for r in range(rows):
            out[r, n_s + j] *= lam
