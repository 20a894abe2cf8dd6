"""Kernel and noise, learned online in constant memory: the state of k samples ago predicts the last k."""

from __future__ import annotations

import math

import torch
from torch import nn

from ..typing import Float, Tensor
from .kernels import Kernel
from .posterior import SparsePosterior, basis_gram


class PrequentialAdaptation(nn.Module):
    """Descends the lagged prequential loss in the kernel's and the noise's parameters theta::

        loss(theta) = mean_t -log p(y_t | x_t, (Omega, h)_{t0}, theta),   t = t0+1 .. t0+k

    (Omega, h) of k samples ago holds neither kernel nor noise, so its prediction is an exact function
    of theta; the k samples were not seen by it, so the loss cannot be won by overfitting. Memory: one
    copy of the basis and k samples. The streaming variational bound needs as much and is a worse
    objective: it inflates the noise.

    Steps shrink like ``1 / sqrt(1 + n/30)``, to a tenth at most: the state was projected with a kernel
    that every later move makes a little wrong, so late moves must earn more than early ones; a system
    that changes is still followed.

    With a robust learner (c given) the Gaussian density becomes a Student t with ``c^2`` degrees of
    freedom, whose influence is bounded like the robust update's.

    Args:
        posterior: the state to watch.
        kernel: whose parameters to change.
        log_noise: log noise variances ``(*batch_shape, out)``, changed too.
        window: k.
        rate: Adam's first step on the logarithms of the hyperparameters.
        network_rate: Adam's first step on parameters that are not logarithms (a deep kernel's weights).
        steps: gradient steps per window.
    """

    window_x: Tensor
    window_y: Tensor
    window_on: Tensor
    old_basis: Tensor
    old_active: Tensor
    old_precision: Tensor
    old_information: Tensor
    n_steps: Tensor

    def __init__(
        self,
        posterior: SparsePosterior,
        kernel: Kernel,
        log_noise: Tensor,
        *,
        window: int,
        rate: float,
        network_rate: float,
        steps: int,
    ) -> None:
        super().__init__()
        self.window, self.rate, self.network_rate, self.steps = window, rate, network_rate, steps
        fleet, like = posterior.batch_shape, posterior.basis
        self.register_buffer("window_x", like.new_zeros(*fleet, window, like.shape[-1]))
        self.register_buffer("window_y", like.new_zeros(*fleet, window, posterior.out_features))
        self.register_buffer("window_on", like.new_zeros(*fleet, window))
        self.register_buffer("old_basis", torch.zeros_like(like))
        self.register_buffer("old_active", torch.zeros_like(posterior.active))
        self.register_buffer("old_precision", torch.zeros_like(posterior.precision).contiguous())
        self.register_buffer("old_information", torch.zeros_like(posterior.information).contiguous())
        self.register_buffer("n_steps", like.new_zeros(fleet))
        for i, p in enumerate([*kernel.parameters(), log_noise]):
            self.register_buffer(f"first_{i}", torch.zeros_like(p.detach()))
            self.register_buffer(f"second_{i}", torch.zeros_like(p.detach()))

    def reset(self) -> None:
        """Forget window, snapshot and step sizes."""
        for buffer in self.buffers():
            buffer.zero_()

    def observe(self, x: Tensor, y: Tensor, mask: Tensor | None, place: int) -> None:
        """Keep a sample (in the units of the snapshot) at a place of the window."""
        self.window_x[..., place, :] = x
        self.window_y[..., place, :] = y
        self.window_on[..., place] = 1.0 if mask is None else mask

    def snapshot(self, posterior: SparsePosterior) -> None:
        """The present state becomes the past one; the window is empty."""
        self.old_basis.copy_(posterior.basis)
        self.old_active.copy_(posterior.active)
        self.old_precision.copy_(posterior.precision)
        self.old_information.copy_(posterior.information)
        self.window_on.zero_()

    def loss(self, kernel: Kernel, log_noise: Tensor, jitter: float, robust: float | None) -> Tensor:
        """Lagged prequential loss of each model, ``(*batch_shape)`` [nats per sample and output]."""
        noise = log_noise.exp()
        s2 = log_noise.mean(-1).exp()[..., None, None]
        L = torch.linalg.cholesky_ex(basis_gram(kernel, self.old_basis, self.old_active, jitter))[0]
        LW = L.mT @ (self.old_precision / s2)
        eye = torch.eye(L.shape[-1], dtype=L.dtype, device=L.device)
        La = torch.linalg.cholesky_ex(eye + LW @ L)[0]
        k = kernel(self.old_basis, self.window_x) * self.old_active.unsqueeze(-1)
        u = torch.linalg.solve_triangular(L, k, upper=False)
        right = torch.cat([u, L.mT @ (self.old_information / s2)], dim=-1)
        right = torch.linalg.solve_triangular(La, right, upper=False)
        g, b = right[..., : self.window], right[..., self.window :]
        v = kernel.diagonal_of_set(self.window_x) - u.square().sum(-2) + g.square().sum(-2)
        variance = v.clamp_min(0.0).unsqueeze(-1) + noise.unsqueeze(-2)
        z2 = (self.window_y - g.mT @ b).square() / variance
        misfit = z2 if robust is None else (robust**2 + 1.0) * torch.log1p(z2 / robust**2)
        density = 0.5 * (misfit + variance.log() + math.log(2 * math.pi)).mean(-1)
        return (density * self.window_on).sum(-1) / self.window_on.sum(-1).clamp_min(1.0)

    def descend(self, kernel: Kernel, log_noise: nn.Parameter, jitter: float, robust: float | None) -> None:
        """Adam on the loss, model by model; a model without samples or finite gradient stays as it is."""
        parameters = [*kernel.parameters(), log_noise]
        names = [name for name, _ in kernel.named_parameters()] + ["log_noise"]
        for _ in range(self.steps):
            with torch.enable_grad():
                for p in parameters:
                    p.requires_grad_(True)
                try:
                    loss = self.loss(kernel, log_noise, jitter, robust).sum()
                    gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
                finally:
                    for p in parameters:
                        p.requires_grad_(False)
            self._adam(parameters, names, gradients)

    def _adam(self, parameters: list, names: list[str], gradients: tuple) -> None:
        on = (self.window_on.sum(-1) > 0).to(self.n_steps.dtype)
        self.n_steps += on
        b1, b2 = 0.9, 0.99
        t = self.n_steps.clamp_min(1.0)
        correction = (1 - b2**t).sqrt() / (1 - b1**t) * _shrink(t)
        for i, (p, name, gradient) in enumerate(zip(parameters, names, gradients, strict=True)):
            if gradient is None:
                continue
            first, second = getattr(self, f"first_{i}"), getattr(self, f"second_{i}")
            logarithm = name.split(".")[-1].startswith("log_")
            fleet = _trailing(on, p)
            good = gradient.isfinite() & (fleet > 0)
            gradient = gradient.where(good, 0.0)
            first.copy_(torch.where(good, b1 * first + (1 - b1) * gradient, first))
            second.copy_(torch.where(good, b2 * second + (1 - b2) * gradient**2, second))
            rate = self.rate if logarithm else self.network_rate
            step = rate * _trailing(correction, p) * first / (second.sqrt() + 1e-8)
            p.sub_(step.where(good, 0.0))
            if logarithm:  # far beyond what normalised data can mean
                p.clamp_(-14.0 if name == "log_noise" else -7.0, 7.0)


def _shrink(n: Tensor) -> Tensor:
    """Size of the n-th step relative to the first."""
    return (1.0 + n / 30.0).rsqrt().clamp_min(0.1)


def _trailing(value: Float[Tensor, "*batch"], like: Tensor) -> Tensor:
    """A per-model value against a parameter; one shared by the fleet takes the mean."""
    if like.shape[: value.dim()] == value.shape:
        return value[(..., *(None,) * (like.dim() - value.dim()))]
    return value.mean()
