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

    Gradients need no differentiation of a factorisation: to first order in a change dK and in that of ln s2
    the caches become::

        alpha + C dK alpha - dln s2 (alpha + C K alpha),   C + C dK C - dln s2 (C + C K C),   Q - Q dK Q

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

    def forward(self, kernel: Kernel, log_noise: Tensor, queries: Queries, *, anew: bool = False) -> Tensor:
        """Loss of each model ``(*batch_shape)`` [nats per sample and output], for autograd to go through.

        The derivatives are those at the values by which the old state's caches were made, or, with ``anew``,
        are made here.
        """
        state, log_s2 = self.state, log_noise.mean(-1)
        if anew:
            state.rebuild(kernel, log_s2.exp())
        gram = state.gram(kernel)
        K = gram.detach()
        alpha, (C, Q) = state.alpha, state.moments[..., :2, :, :].unbind(-3)
        dK, d, CK = gram - K, (log_s2 - log_s2.detach())[..., None, None], C @ K
        alpha, C, Q = (
            alpha + C @ (dK @ alpha) - d * (alpha + CK @ alpha),
            C + C @ dK @ C - d * (C + CK @ C),
            Q - Q @ dK @ Q,
        )
        k = kernel(state.basis, queries.x)  # rows of free slots are 0 in all of these
        kCk, u = ((A @ k * k).sum(-2) for A in (C, Q))
        v = kernel.diagonal_of_set(queries.x) + kCk
        return self._density(k.mT @ alpha, v, u + kCk, u, log_noise, queries)

    def _density(
        self, mean: Tensor, v: Tensor, p: Tensor, u: Tensor, log_noise: Tensor, queries: Queries
    ) -> Tensor:
        """The loss from the state's predictions."""
        s2, noise = log_noise.mean(-1, keepdim=True).exp(), log_noise.exp().unsqueeze(-2)
        on, tiny = queries.weight, torch.finfo(p.dtype).tiny
        # c: what residual and p of each query grow by once it is left out of the state
        held = queries.absorbed * on * self.forgetting_factor**queries.age / s2
        exact = 1.0 / (1.0 - held * p).clamp_min(torch.finfo(p.dtype).eps)
        most = (u / p.clamp_min(tiny)).clamp_min(1.0)
        c = torch.where(exact > most, most, exact)
        variance = (v + p * (c - 1.0)).clamp_min(0.0).unsqueeze(-1) + noise
        z2, robust = ((queries.y - mean) * c.unsqueeze(-1)).square() / variance, self.robust
        misfit = z2 if robust is None else (robust**2 + 1.0) * torch.log1p(z2 / robust**2)
        share = on / on.sum(-1, keepdim=True).clamp_min(tiny)
        return (0.5 * (misfit + variance.log() + math.log(2 * math.pi)).mean(-1) * share).sum(-1)
