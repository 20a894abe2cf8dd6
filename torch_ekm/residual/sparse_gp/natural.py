"""From the natural form (W, h) of a sparse posterior to what predictions need."""

from __future__ import annotations

import torch

from ...typing import Float, Tensor


def posterior_from_natural(
    K: Float[Tensor, "*batch b b"], W: Float[Tensor, "*batch b b"], h: Float[Tensor, "*batch b m"]
) -> tuple[Tensor, Tensor, Tensor]:
    """``p(f) ~ N(f; 0, K) exp(-1/2 f'W f + h'f)`` as ``(Q, C, alpha)``.

    ``Q = K^-1``, ``C = -(K + W^-1)^-1``, ``alpha = K^-1 (K^-1 + W)^-1 h``, so that a query has mean
    ``alpha'k`` and variance ``k** + k'Ck`` (Csato & Opper, Neural Computation 14, 2002). W may be
    singular. With ``K = LL'``, ``A = I + L'WL``::

        C = -(K^-1 - L^-T A^-1 L^-1),   alpha = L^-T A^-1 L'h

    ``L^-T A^-1 L^-1`` is the posterior covariance of ``K^-1 f``: the difference keeps its relative
    accuracy when W is large (many repeats), where ``T'T - W`` loses all of it. Factorised in double
    precision whatever the dtype: a float32 state is limited by its storage, not by this step.
    """
    L = torch.linalg.cholesky_ex(K.double())[0]
    W, h = W.double(), h.double()
    eye = torch.eye(K.shape[-1], dtype=L.dtype, device=L.device)
    A = eye + L.mT @ W @ L
    La = torch.linalg.cholesky_ex(0.5 * (A + A.mT))[0]
    L_inv = torch.linalg.solve_triangular(L, eye.expand_as(L), upper=False)
    G = torch.linalg.solve_triangular(La, L_inv, upper=False)
    Q = L_inv.mT @ L_inv
    alpha = G.mT @ torch.linalg.solve_triangular(La, L.mT @ h, upper=False)
    return Q.to(K.dtype), (G.mT @ G - Q).to(K.dtype), alpha.to(K.dtype)
