"""The state of a sparse GP posterior on a bounded basis."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from ..._recorded import precision_problems
from ...exceptions import ParameterError
from ...typing import Bool, Float, Tensor
from ..kernels.kernel import Kernel


class SparsePosterior(nn.Module):
    """``exp(-1/2 f'Omega f/s2 + h'f/s2) N(f; 0, K)`` on at most ``capacity`` basis vectors.

    Master copy is (basis, Omega, h): Omega is a sum of squares, so it stays positive, and it holds
    neither kernel nor noise. alpha, C, Q are caches with ``mean = alpha'k``, ``var = k** + k'Ck``,
    ``Q = K^-1``: an engine carries them along by rank-one steps, :meth:`rebuild` makes them again.
    Always float64, see :class:`~torch_ekm.residual.SparseOnlineGP`. Arguments as there.
    """

    jitter = 1e-6  #: nugget on k(x, x) at basis vectors, relative to k**

    def __init__(
        self,
        in_features: int,
        out_features: int,
        capacity: int,
        *,
        novelty_threshold: float,
        batch_shape: tuple[int, ...] = (),
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        if not 0 <= novelty_threshold < 1:
            raise ParameterError("novelty_threshold", novelty_threshold, "in [0, 1)")
        self.capacity, self.batch_shape, self.out_features = capacity, batch_shape, out_features
        self.novelty_threshold = novelty_threshold
        factory = {"dtype": torch.float64, "device": device}
        # One slot more than the capacity: a new point moves in before another is pruned. What a
        # free slot holds in `basis` is meaningless; its rows and columns elsewhere are 0.
        M = capacity + 1
        self.basis = nn.Buffer(torch.zeros(*batch_shape, M, in_features, **factory))
        self.active = nn.Buffer(torch.zeros(*batch_shape, M, **factory))
        self.count = nn.Buffer(torch.zeros(batch_shape, dtype=torch.int64, device=device))
        self.slot = nn.Buffer(torch.zeros(batch_shape, dtype=torch.int64, device=device))
        # [C; Q; Omega] and [alpha; h] each in one buffer: one product, one rank update serves all.
        self.moments = nn.Buffer(torch.zeros(*batch_shape, 3, M, M, **factory))
        self.vectors = nn.Buffer(torch.zeros(*batch_shape, 2, M, out_features, **factory))
        self.slots = nn.Buffer(torch.arange(M, device=device), persistent=False)

    @property
    def alpha(self) -> Float[Tensor, "*batch slots out"]:
        """alpha, the coefficients of the mean, in the learner's units of y."""
        return self.vectors[..., 0, :, :]

    @property
    def information(self) -> Float[Tensor, "*batch slots out"]:
        """h, what samples say of the mean, in the learner's units of y."""
        return self.vectors[..., 1, :, :]

    @property
    def covariance(self) -> Float[Tensor, "*batch slots slots"]:
        """C, the change of the covariance: negative semi-definite."""
        return self.moments[..., 0, :, :]

    @property
    def precision(self) -> Float[Tensor, "*batch slots slots"]:
        """Omega: how often, and with which weight, each direction of f was seen."""
        return self.moments[..., 2, :, :]

    def state_problems(self, state: Mapping[str, Any]) -> list[str]:
        """What is wrong with a state of these shapes: compiled loops write where its counts lead them."""
        count, slot, active = (state[name] for name in ("count", "slot", "active"))
        if bool((count > self.capacity).any() | (slot > self.capacity).any()):
            return [f"count and slot: beyond the capacity of {self.capacity}"]
        if bool(((count < self.capacity) & (slot != count)).any()):
            return ["slot: not the first free one"]
        taken = active.gather(-1, slot.unsqueeze(-1)).squeeze(-1)
        if bool(((active != 0) & (active != 1)).any() | (active.sum(-1) != count).any() | (taken != 0).any()):
            return ["active: not as many points as count says, or one where slot is"]
        return precision_problems("moments[2]", state["moments"][..., 2, :, :])

    def reset(self) -> None:
        """Back to the prior, without a basis vector."""
        for buffer in self.buffers(recurse=False):
            if buffer is not self.slots:
                buffer.zero_()

    def forget(self, models: Bool[Tensor, "*batch"]) -> None:
        """These models go back to the prior but keep their basis vectors."""
        keep = (~models)[..., None, None]
        for block in (self.covariance, self.precision, self.alpha, self.information):
            block.mul_(keep)

    def gram(self, kernel: Kernel) -> Float[Tensor, "*batch slots slots"]:
        """K(X, X) with ``jitter k**`` on the diagonal; the identity at free slots. Differentiable."""
        on = self.active.unsqueeze(-1)
        K = kernel(self.basis, self.basis) * (on * on.mT)
        diagonal = kernel.diagonal_of_set(self.basis) * (1.0 + self.jitter)
        diagonal = torch.where(self.active > 0, diagonal, 1.0)
        return (0.5 * (K + K.mT)).diagonal_scatter(diagonal, dim1=-2, dim2=-1)

    @torch.no_grad()
    def rebuild(self, kernel: Kernel, s2: Float[Tensor, "*batch"]) -> None:
        """alpha, C, Q from the natural form by Cholesky."""
        s2 = s2[..., None, None]
        on = self.active.unsqueeze(-1)
        Q, C, alpha = posterior_from_natural(self.gram(kernel), self.precision / s2, self.information / s2)
        # a free slot has K = 1, so Q = 1 there: it must be 0 like the rest of its row
        self.covariance.copy_(C)
        torch.mul(Q, on * on.mT, out=self.moments.select(-3, 1))
        self.alpha.copy_(alpha)


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
    precision for any dtype: a float32 state is limited by its storage, not by this step.
    """
    L = torch.linalg.cholesky_ex(K.double())[0]
    W, h = W.double(), h.double()
    A = L.mT @ W @ L
    A.diagonal(dim1=-2, dim2=-1).add_(1.0)
    La = torch.linalg.cholesky_ex(A)[0]  # which reads its lower half alone
    eye = torch.eye(K.shape[-1], dtype=L.dtype, device=L.device)
    L_inv = torch.linalg.solve_triangular(L, eye.expand_as(L), upper=False)
    G = torch.linalg.solve_triangular(La, L_inv, upper=False)
    Q = L_inv.mT @ L_inv
    alpha = G.mT @ torch.linalg.solve_triangular(La, L.mT @ h, upper=False)
    return Q.to(K.dtype), (G.mT @ G).sub_(Q).to(K.dtype), alpha.to(K.dtype)
