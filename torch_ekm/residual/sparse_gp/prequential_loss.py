"""The lagged prequential loss of a kernel and its gradients: the state of k samples ago predicts others."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import torch
from torch import nn

from ...typing import Float, Tensor
from ..kernels.kernel import Kernel
from .posterior import SparsePosterior


class Queries(NamedTuple):
    """What is predicted, in the units of the snapshot: the window, then what was seen before."""

    x: Float[Tensor, "*batch n in"]
    y: Float[Tensor, "*batch n out"]
    weight: Float[Tensor, "*batch n"]
    absorbed: Float[Tensor, " n"]  # 1: part of the state, to be left out of it
    age: Float[Tensor, " n"]  # samples since then


class _Slopes(NamedTuple):
    """Derivatives of the loss, by what the state says of the queries and by the noise."""

    mean: Tensor
    variance: Tensor
    p: Tensor
    u: Tensor
    log_noise: Tensor


class PrequentialLoss(nn.Module):
    """A state of the past, and how well it predicts samples with other hyperparameters theta::

        loss(theta) = mean_t -log p(y_t | x_t, (Omega, h), theta)

    (Omega, h) holds neither kernel nor noise, so its prediction is an exact function of theta. Samples that
    the state has seen are each left out of it in closed form. With ``u = k'Qk`` the prior variance of the
    basis' prediction of the sample, p its posterior variance and w what is left of its weight in the state
    (Rasmussen & Williams 2006, section 5.4.2, for a sparse model)::

        residual <- c residual,  p <- c p,   c = 1 / (1 - w p/s2), at most u/p

    since without any sample p would be u. That is honest only where noise is fresh at each sample: where it
    is carried from one to the next, the neighbours in time still hold the one left out.

    Gradients need no differentiation of a factorisation. From ``d alpha = C dK alpha``, ``dC = C dK C`` and
    ``dQ = -Q dK Q``, with ``E = Ck``, ``F = Qk`` and the loss' derivatives ``g`` by mean, variance
    ``v = k** + k'Ck``, ``p = u + k'Ck`` and u of each query::

        by K:  E (g_mean alpha' + diag(g_v + g_p) E') - F diag(g_p + g_u) F'
        by k:  alpha g_mean' + 2 E diag(g_v + g_p) + 2 F diag(g_p + g_u)
        by ln s2:  -sum g_mean (mean + E'K alpha) - sum (g_v + g_p) diag(k'E + E'KE)

    Args:
        posterior: whose copy is the state.
        forgetting_factor: on what the state holds, per sample.
        robust: c; the Gaussian density becomes a Student t with ``c^2`` degrees of freedom, whose influence
            is bounded like the robust update's. None: Gaussian.
    """

    def __init__(self, posterior: SparsePosterior, forgetting_factor: float, robust: float | None) -> None:
        super().__init__()
        self.state = copy.deepcopy(posterior)
        self.forgetting_factor, self.robust = forgetting_factor, robust

    def snapshot(self, posterior: SparsePosterior) -> None:
        """The present state becomes the past one."""
        for old, new in zip(self.state.buffers(), posterior.buffers(), strict=True):
            old.copy_(new)

    def with_gradients(
        self, kernel: Kernel, log_noise: Tensor, queries: Queries
    ) -> tuple[Tensor, list[Tensor | None]]:
        """Loss of each model ``(*batch_shape)`` [nats per sample and output], derivatives of their sum.

        The derivatives are those by ``[*kernel.parameters(), log_noise]``, at the values by which the old
        state's caches were made.
        """
        with _differentiable(kernel):
            K, k, prior = outcome = self._covariances(kernel, queries.x)
            K_, k_ = K.detach(), k.detach()
            C, Q, alpha = self.state.covariance, self.state.moments[..., 1, :, :], self.state.alpha
            E, F = C @ k_, Q @ k_
            kE, u, mean = (k_ * E).sum(-2), (k_ * F).sum(-2), k_.mT @ alpha
            loss, by = self._density(mean, prior.detach() + kE, u + kE, u, log_noise, queries)

            E_g, F_g = E * (by.variance + by.p).unsqueeze(-2), F * (by.p + by.u).unsqueeze(-2)
            by_K = (E @ by.mean) @ alpha.mT + E_g @ E.mT - F_g @ F.mT
            by_k = alpha @ by.mean.mT + 2.0 * (E_g + F_g)
            by_s2 = (by.mean * (mean + E.mT @ (K_ @ alpha))).sum((-1, -2))
            by_s2 = by_s2 + (E_g * (k_ + K_ @ E)).sum((-1, -2))
            by_noise = by.log_noise - by_s2.unsqueeze(-1) / log_noise.shape[-1]
            parameters = list(kernel.parameters())
            by_kernel = torch.autograd.grad(outcome, parameters, [by_K, by_k, by.variance], allow_unused=True)
        return loss, [*by_kernel, by_noise]

    def _covariances(self, kernel: Kernel, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """K at the old basis, k and k** of the queries, from one evaluation of the kernel."""
        basis, M = self.state.basis, self.state.basis.shape[-2]
        both = kernel(basis, torch.cat([basis, x], dim=-2))
        k = both[..., M:] * self.state.active.unsqueeze(-1)
        return self.state.as_gram(both[..., :M], kernel), k, kernel.diagonal_of_set(x)

    def _density(
        self, mean: Tensor, v: Tensor, p: Tensor, u: Tensor, log_noise: Tensor, queries: Queries
    ) -> tuple[Tensor, _Slopes]:
        """The loss from the state's predictions, and its derivatives by them."""
        leaves = [value.detach().requires_grad_(True) for value in (mean, v, p, u, log_noise)]
        mean, v, p, u, log_noise = leaves
        c = self._left_out(p, u, log_noise.mean(-1, keepdim=True).exp(), queries)
        variance = (v + p * (c - 1.0)).clamp_min(0.0).unsqueeze(-1) + log_noise.exp().unsqueeze(-2)
        z2 = ((queries.y - mean) * c.unsqueeze(-1)).square() / variance
        robust = self.robust
        misfit = z2 if robust is None else (robust**2 + 1.0) * torch.log1p(z2 / robust**2)
        density = 0.5 * (misfit + variance.log() + math.log(2 * math.pi)).mean(-1)
        on = queries.weight
        loss = (density * on).sum(-1) / on.sum(-1).clamp_min(torch.finfo(on.dtype).tiny)
        return loss.detach(), _Slopes(*torch.autograd.grad(loss.sum(), leaves, materialize_grads=True))

    def _left_out(self, p: Tensor, u: Tensor, s2: Tensor, queries: Queries) -> Tensor:
        """c: what residual and p of each query grow by once it is left out of the state."""
        most = (u / p.clamp_min(torch.finfo(p.dtype).tiny)).clamp_min(1.0)
        weight = queries.absorbed * queries.weight * self.forgetting_factor**queries.age
        return torch.minimum(1.0 / (1.0 - weight * p / s2).clamp_min(torch.finfo(p.dtype).eps), most)


@contextmanager
def _differentiable(kernel: Kernel) -> Iterator[None]:
    """Inside, the kernel's parameters carry a graph."""
    try:
        kernel.requires_grad_(True)
        with torch.enable_grad():
            yield
    finally:
        kernel.requires_grad_(False)
