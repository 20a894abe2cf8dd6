"""The lagged prequential loss of a kernel and its gradients: the state of k samples ago predicts others."""

from __future__ import annotations

import copy
import math
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
        self, kernel: Kernel, log_noise: Tensor, queries: Queries, *, anew: bool = False
    ) -> tuple[Tensor, list[Tensor | None]]:
        """Loss of each model ``(*batch_shape)`` [nats per sample and output], derivatives of their sum.

        The derivatives are by the kernel's hyperparameters and log_noise, at the values by which the old
        state's caches were made, or, with ``anew``, are made here.
        """
        M, alpha = self.state.basis.shape[-2], self.state.alpha
        both, diagonal, pullback = kernel.with_pullback(torch.cat([self.state.basis, queries.x], dim=-2), M)
        K, k = self.state.as_gram(both[..., :M], diagonal[..., :M]), both[..., M:]
        if anew:
            self.state.rebuild_from(K, log_noise.mean(-1).exp())
        E, F = (self.state.moments[..., :2, :, :] @ k.unsqueeze(-3)).unbind(-3)
        kE, u, mean = (k * E).sum(-2), (k * F).sum(-2), k.mT @ alpha
        loss, by = self._density(mean, diagonal[..., M:] + kE, u + kE, u, log_noise, queries)

        E_g, F_g = E * (by.variance + by.p).unsqueeze(-2), F * (by.p + by.u).unsqueeze(-2)
        by_K = (E @ by.mean) @ alpha.mT + E_g @ E.mT
        by_s2 = (by.mean * mean).sum((-1, -2)) + (E_g * k).sum((-1, -2)) + (by_K * K).sum((-1, -2))
        by_noise = by.log_noise - by_s2.unsqueeze(-1) / log_noise.shape[-1]
        by_K -= F_g @ F.mT
        by_k = alpha @ by.mean.mT + 2.0 * (E_g + F_g)
        # rows of free slots are 0 in all of these; the diagonal of K has the jitter on it
        by_own = by_K.diagonal(dim1=-2, dim2=-1)
        by_diagonal = torch.cat([by_own * (1.0 + self.state.jitter), by.variance], dim=-1)
        by_own.zero_()
        by_kernel = pullback(torch.cat([by_K, by_k], dim=-1), by_diagonal)
        return loss, [*by_kernel, by_noise]

    def _density(
        self, mean: Tensor, v: Tensor, p: Tensor, u: Tensor, log_noise: Tensor, queries: Queries
    ) -> tuple[Tensor, _Slopes]:
        """The loss from the state's predictions, and its derivatives by them, each by the chain rule."""
        s2, noise = log_noise.mean(-1, keepdim=True).exp(), log_noise.exp().unsqueeze(-2)
        on, tiny, m = queries.weight, torch.finfo(p.dtype).tiny, mean.shape[-1]
        # c: what residual and p of each query grow by once it is left out of the state
        held = queries.absorbed * on * self.forgetting_factor**queries.age / s2
        exact = 1.0 / (1.0 - held * p).clamp_min(torch.finfo(p.dtype).eps)
        least = p.clamp_min(tiny)
        most = (u / least).clamp_min(1.0)
        c, bounded = torch.minimum(exact, most), exact > most
        left = v + p * (c - 1.0)
        variance = left.clamp_min(0.0).unsqueeze(-1) + noise
        residual, factor, robust = queries.y - mean, c.unsqueeze(-1), self.robust
        z2 = (residual * factor).square() / variance
        misfit = z2 if robust is None else (robust**2 + 1.0) * torch.log1p(z2 / robust**2)
        share = on / on.sum(-1, keepdim=True).clamp_min(tiny)
        loss = (0.5 * (misfit + variance.log() + math.log(2 * math.pi)).mean(-1) * share).sum(-1)

        each = (0.5 / m) * share.unsqueeze(-1)
        by_z2 = each if robust is None else each * (robust**2 + 1.0) / (robust**2 + z2)
        pull = 2.0 * by_z2 * residual * factor / variance
        by_variance = (each - by_z2 * z2) / variance
        by_left = by_variance.sum(-1) * (left >= 0)
        by_c = (pull * residual).sum(-1) + by_left * p
        by_exact = torch.where(bounded, 0.0, by_c) * exact.square() * held
        by_most = by_c * (bounded & (u >= least)) / least
        by_s2 = -(by_exact * p).sum(-1, keepdim=True)  # times s2
        by_log_noise = (by_variance * noise).sum(-2) + by_s2 / m
        by_p = by_left * (c - 1.0) + by_exact - by_most * most
        return loss, _Slopes(-pull * factor, by_left, by_p, by_most, by_log_noise)
