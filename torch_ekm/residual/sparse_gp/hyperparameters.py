"""Kernel and noise, learned online in constant memory: the state of k samples ago predicts the last k."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import torch
from torch import nn

from ...typing import Bool, Float, Tensor
from ..kernels.kernel import Kernel, is_shared
from .posterior import SparsePosterior, as_gram
from .replay import ReplayMemory

#: Inputs and outputs of sets of samples, to the learner's units.
Units = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
_REPLAYED = 4  # samples of the memory per sample of the window, in each step; at least as many as points


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


class PrequentialAdaptation(nn.Module):
    """Descends the lagged prequential loss in the kernel's and the noise's parameters theta::

        loss(theta) = mean_t -log p(y_t | x_t, (Omega, h)_{t0}, theta),   t = t0+1 .. t0+k

    (Omega, h) of k samples ago holds neither kernel nor noise, so its prediction is an exact function
    of theta; the k samples were not seen by it, so the loss cannot be won by overfitting. Memory: one
    copy of the state and k samples. The streaming variational bound needs as much and is a worse
    objective: it inflates the noise.

    With a memory, each step predicts 4 k samples of the past too (as many as basis points, if these are
    more), so that a network with thousands of weights does not run after the last k. The state has seen
    them; each is left out of it in closed form.
    With ``u = k'Qk`` the prior variance of the basis' prediction of the sample, p its posterior variance and
    w what is left of its weight in the state (Rasmussen & Williams 2006, section 5.4.2, for a sparse model)::

        residual <- c residual,  p <- c p,   c = 1 / (1 - w p/s2), at most u/p

    since without any sample p would be u. That is honest only where noise is fresh at each sample: where it
    is carried from one to the next, the neighbours in time tell on the one left out.

    Gradients need no differentiation of a factorisation. From ``d alpha = C dK alpha``, ``dC = C dK C`` and
    ``dQ = -Q dK Q``, with ``E = Ck``, ``F = Qk`` and the loss' derivatives ``g`` by mean, variance
    ``v = k** + k'Ck``, ``p = u + k'Ck`` and u of each query::

        by K:  E (g_mean alpha' + diag(g_v + g_p) E') - F diag(g_p + g_u) F'
        by k:  alpha g_mean' + 2 E diag(g_v + g_p) + 2 F diag(g_p + g_u)
        by ln s2:  -sum g_mean (mean + E'K alpha) - sum (g_v + g_p) diag(k'E + E'KE)

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
        memory: number of earlier samples to keep, 0 for none.
        forgetting: factor on what the state holds, per sample.
        expects_changes: whether :meth:`forget` will be called.
    """

    window_x: Tensor
    window_y: Tensor
    window_on: Tensor
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
        memory: int = 0,
        forgetting: float = 1.0,
        expects_changes: bool = False,
    ) -> None:
        super().__init__()
        self.forgetting = forgetting
        self.shared_kernel = is_shared(kernel, posterior.basis.shape[-1])
        self.window, self.rate, self.network_rate, self.steps = window, rate, network_rate, steps
        fleet, like = posterior.batch_shape, posterior.basis
        self.register_buffer("window_x", like.new_zeros(*fleet, window, like.shape[-1]))
        self.register_buffer("window_y", like.new_zeros(*fleet, window, posterior.out_features))
        self.register_buffer("window_on", like.new_zeros(*fleet, window))
        self.old = copy.deepcopy(posterior)
        self.register_buffer("n_steps", like.new_zeros(fleet))
        for i, p in enumerate([*kernel.parameters(), log_noise]):
            self.register_buffer(f"first_{i}", torch.zeros_like(p.detach()))
            self.register_buffer(f"second_{i}", torch.zeros_like(p.detach()))
        horizon = math.inf if forgetting == 1.0 else 1.0 / (1.0 - forgetting)
        if expects_changes:  # so that the new system's samples are let in at once
            horizon = min(horizon, memory)
        self.memory = ReplayMemory(posterior, memory, horizon) if memory else None

    def reset(self) -> None:
        """Forget window, snapshot, memory and step sizes."""
        for buffer in self.buffers(recurse=False):
            buffer.zero_()
        self.old.reset()
        if self.memory is not None:
            self.memory.reset()

    def observe(self, x: Tensor, y: Tensor, mask: Tensor | None, weight: Tensor, place: int) -> None:
        """Keep a sample, in its own units, at a place of the window; its weight is that in the update."""
        self.window_x[..., place, :] = x
        self.window_y[..., place, :] = y
        self.window_on[..., place] = 1.0 if mask is None else mask
        if self.memory is not None:
            self.memory.offer(x, y, weight if mask is None else weight * mask)

    def snapshot(self, posterior: SparsePosterior) -> None:
        """The present state becomes the past one; the window is empty."""
        for old, new in zip(self.old.buffers(), posterior.buffers(), strict=True):
            old.copy_(new)
        self.window_on.zero_()
        if self.memory is not None:
            self.memory.settle()

    def forget(self, models: Bool[Tensor, "*batch"]) -> None:
        """These models face another system: what they kept does not count any more."""
        self.window_on.masked_fill_(models.unsqueeze(-1), 0.0)
        self.old.forget(models)
        if self.memory is not None:
            self.memory.forget(models)

    def queries(self, units: Units) -> Queries:
        """The window, and this turn's part of the memory."""
        x, y, weight = self.window_x, self.window_y, self.window_on
        absorbed = age = x.new_zeros(self.window)
        if self.memory is not None:
            n = max(_REPLAYED * self.window, self.old.capacity)
            x_past, y_past, weight_past, age_past = self.memory.take(n)
            x, y = torch.cat([x, x_past], dim=-2), torch.cat([y, y_past], dim=-2)
            weight = torch.cat([weight, weight_past], dim=-1)
            absorbed, age = torch.cat([absorbed, torch.ones_like(age_past)]), torch.cat([age, age_past])
        return Queries(*units(x, y), weight, absorbed, age)

    def loss_and_gradients(
        self,
        kernel: Kernel,
        log_noise: Tensor,
        queries: Queries,
        *,
        moved: bool = True,
    ) -> tuple[Tensor, list[Tensor | None]]:
        """Loss of each model ``(*batch_shape)`` [nats per sample and output], derivatives of their sum.

        The derivatives are those by ``[*kernel.parameters(), log_noise]``.

        Args:
            moved: whether kernel or noise changed since the old state's caches were made: they are
                made anew then.
        """
        with _differentiable(kernel) as parameters:
            K, k, prior = outcome = self._covariances(kernel, queries.x)
            K_, k_ = K.detach(), k.detach()
            if moved:
                self.old.rebuild_from(K_, log_noise.mean(-1).exp())
            C, Q, alpha = self.old.covariance, self.old.moments[..., 1, :, :], self.old.alpha
            E, F = C @ k_, Q @ k_
            kE, u, mean = (k_ * E).sum(-2), (k_ * F).sum(-2), k_.mT @ alpha
            loss, by = self._density(mean, prior.detach() + kE, u + kE, u, log_noise, queries)

            E_g, F_g = E * (by.variance + by.p).unsqueeze(-2), F * (by.p + by.u).unsqueeze(-2)
            by_K = (E @ by.mean) @ alpha.mT + E_g @ E.mT - F_g @ F.mT
            by_k = alpha @ by.mean.mT + 2.0 * (E_g + F_g)
            by_s2 = (by.mean * (mean + E.mT @ (K_ @ alpha))).sum((-1, -2))
            by_s2 = by_s2 + (E_g * (k_ + K_ @ E)).sum((-1, -2))
            by_noise = by.log_noise - by_s2.unsqueeze(-1) / log_noise.shape[-1]
            by_kernel = torch.autograd.grad(outcome, parameters, [by_K, by_k, by.variance], allow_unused=True)
        return loss, [*by_kernel, by_noise]

    def _covariances(self, kernel: Kernel, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """K at the old basis, k and k** of the queries, from one evaluation of the kernel."""
        basis, active = self.old.basis, self.old.active
        both = kernel(basis, torch.cat([basis, x], dim=-2))
        M = basis.shape[-2]
        K = as_gram(both[..., :M], kernel, basis, active, self.old.jitter)
        return K, both[..., M:] * active.unsqueeze(-1), kernel.diagonal_of_set(x)

    def _density(
        self,
        mean: Tensor,
        v: Tensor,
        p: Tensor,
        u: Tensor,
        log_noise: Tensor,
        queries: Queries,
    ) -> tuple[Tensor, _Slopes]:
        """The loss from the state's predictions, and its derivatives by them."""
        leaves = [value.detach().requires_grad_(True) for value in (mean, v, p, u, log_noise)]
        mean, v, p, u, log_noise = leaves
        c = self._left_out(p, u, log_noise.mean(-1, keepdim=True).exp(), queries)
        variance = (v + p * (c - 1.0)).clamp_min(0.0).unsqueeze(-1) + log_noise.exp().unsqueeze(-2)
        z2 = ((queries.y - mean) * c.unsqueeze(-1)).square() / variance
        robust = self.old.robust
        misfit = z2 if robust is None else (robust**2 + 1.0) * torch.log1p(z2 / robust**2)
        density = 0.5 * (misfit + variance.log() + math.log(2 * math.pi)).mean(-1)
        on = (queries.weight > 0).to(density.dtype)
        loss = (density * on).sum(-1) / on.sum(-1).clamp_min(1.0)
        return loss.detach(), _Slopes(*torch.autograd.grad(loss.sum(), leaves, materialize_grads=True))

    def _left_out(self, p: Tensor, u: Tensor, s2: Tensor, queries: Queries) -> Tensor:
        """c: what residual and p of each query grow by once it is left out of the state."""
        if self.memory is None:
            return torch.ones_like(p)
        most = (u / p.clamp_min(torch.finfo(p.dtype).tiny)).clamp_min(1.0)
        weight = queries.absorbed * queries.weight * self.forgetting**queries.age
        return torch.minimum(1.0 / (1.0 - weight * p / s2).clamp_min(torch.finfo(p.dtype).eps), most)

    def descend(self, kernel: Kernel, log_noise: nn.Parameter, units: Units) -> None:
        """Adam on the loss, model by model; a model without samples or finite gradient stays as it is."""
        parameters = [*kernel.parameters(), log_noise]
        names = [name for name, _ in kernel.named_parameters()] + ["log_noise"]
        for step in range(self.steps):
            queries = self.queries(units)
            _, gradients = self.loss_and_gradients(kernel, log_noise, queries, moved=step > 0)
            self._adam(parameters, names, gradients)

    def _adam(self, parameters: list, names: list[str], gradients: list) -> None:
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
            shared = self.shared_kernel and name != "log_noise"
            good = gradient.isfinite() & (_spread(on, p, shared) > 0)
            gradient = gradient.where(good, 0.0)
            first.copy_(torch.where(good, b1 * first + (1 - b1) * gradient, first))
            second.copy_(torch.where(good, b2 * second + (1 - b2) * gradient**2, second))
            rate = self.rate if logarithm else self.network_rate
            step = rate * _spread(correction, p, shared) * first / (second.sqrt() + 1e-8)
            p.sub_(step.where(good, 0.0))
            if logarithm:  # far beyond what normalised data can mean
                p.clamp_(-14.0 if name == "log_noise" else -7.0, 7.0)


def _shrink(n: Tensor) -> Tensor:
    """Size of the n-th step relative to the first."""
    return (1.0 + n / 30.0).rsqrt().clamp_min(0.1)


def _spread(value: Float[Tensor, "*batch"], like: Tensor, shared: bool) -> Tensor:
    """A value per model against a parameter; one shared by the fleet takes the mean."""
    if shared or like.shape[: value.dim()] != value.shape:
        return value.mean()
    return value[(..., *(None,) * (like.dim() - value.dim()))]


@contextmanager
def _differentiable(kernel: Kernel) -> Iterator[list[nn.Parameter]]:
    """Inside, the kernel's parameters carry a graph."""
    parameters = list(kernel.parameters())
    with torch.enable_grad():
        try:
            for p in parameters:
                p.requires_grad_(True)
            yield parameters
        finally:
            for p in parameters:
                p.requires_grad_(False)
