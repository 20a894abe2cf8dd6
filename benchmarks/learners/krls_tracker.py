"""Kernel recursive least squares tracker."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from torch_ekm._checks import check_count, check_fraction, check_positive
from torch_ekm.residual import Kernel, Matern32, UpdateEvent, UpdateReport
from torch_ekm.residual.baselines.scaled import ScaledLearner
from torch_ekm.residual.kinds import DoubleStateLearner, SingleLearner
from torch_ekm.typing import Tensor


class KRLSTracker(ScaledLearner, SingleLearner, DoubleStateLearner):
    """Posterior of f at the basis, ``N(mu, Sigma)``, forgotten back to the prior at every step::

        Sigma <- lam Sigma + (1 - lam) K,   mu <- sqrt(lam) mu
        mean = k'Q mu,   var = k** + k'Q (Sigma - K) Q k,   Q = K^-1

    Pruned by the smallest error in the mean, ``|Q mu|_i^2 / Q_ii^2`` (Van Vaerenbergh, Lazaro-Gredilla
    & Santamaria, IEEE TNNLS 23, 2012). One model; state in float64.

    Args:
        capacity: largest number of basis vectors.
        kernel: default Matern 3/2 with lengthscale sqrt(in_features).
        noise_variance: s2.
        forgetting_factor: lam in (0, 1].
        options: see ScaledLearner; ``batch_shape`` must be ().
    """

    jitter = 1e-6  #: nugget relative to k**, also the tolerance below which a sample is not novel

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        capacity: int = 100,
        kernel: Kernel | None = None,
        noise_variance: float = 0.1,
        forgetting_factor: float = 1.0,
        **options: Any,
    ) -> None:
        super().__init__(in_features, out_features, **options)
        self.capacity = check_count("capacity", capacity)
        self.noise_variance = check_positive("noise_variance", noise_variance)
        self.forgetting_factor = check_fraction("forgetting_factor", forgetting_factor)
        factory = {"dtype": torch.float64, "device": self.device}
        self.kernel = Matern32(in_features, **factory) if kernel is None else kernel.double()
        M = self.capacity + 1
        self.basis = nn.Buffer(torch.zeros(M, self.in_features, **factory))
        self.mu = nn.Buffer(torch.zeros(M, self.out_features, **factory))
        self.Sigma = nn.Buffer(torch.zeros(M, M, **factory))
        self.Q = nn.Buffer(torch.zeros(M, M, **factory))
        self.active = nn.Buffer(torch.zeros(M, dtype=torch.bool, device=self.device))
        self._make_units(self.kernel.shift_invariant(self.in_features), torch.float64)

    def _clear(self, models: Tensor | None = None) -> None:
        for buffer in (self.basis, self.mu, self.Sigma, self.Q, self.active):
            buffer.zero_()

    def _mean(self, z: Tensor) -> Tensor:
        return self._cross(z) @ self.Q @ self.mu

    def _law(self, z: Tensor, observation: bool) -> tuple[Tensor, Tensor]:
        """``k** - k'Qk + (Qk)'Sigma(Qk)``, plus s2 on request."""
        k = self._cross(z)
        e = k @ self.Q
        v = (self.kernel.diagonal(z) - (e * k).sum(-1)).clamp_min(0.0) + ((e @ self.Sigma) * e).sum(-1)
        v = v + self.noise_variance if observation else v.clamp_min(torch.finfo(v.dtype).eps)
        return e @ self.mu, v.unsqueeze(-1)

    def _follow(self, change: tuple[Tensor, Tensor], change_t: tuple[Tensor, Tensor]) -> None:
        """The same beliefs at the same places, in other numbers."""
        (offset, ratio), (offset_t, ratio_t) = change, change_t
        self.basis.add_(offset).mul_(ratio)
        self.mu.add_(offset_t).mul_(ratio_t).mul_(self.active[:, None])
        self.Sigma.mul_(ratio_t.square().mean())
        K = self.kernel(self.basis, self.basis) * (self.active[:, None] & self.active)
        K.diagonal().copy_(torch.where(self.active, K.diagonal() * (1.0 + self.jitter), 1.0))
        inverse = torch.cholesky_inverse(torch.linalg.cholesky_ex(K)[0])
        self.Q.copy_(inverse * (self.active[:, None] & self.active))

    def _learn(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        lam = self.forgetting_factor
        if lam < 1.0:
            on = self.active.double()
            K = self.kernel(self.basis, self.basis) * on[:, None] * on
            K.diagonal().mul_(1.0 + self.jitter)
            self.Sigma.mul_(lam).add_(K, alpha=1.0 - lam)
            self.mu.mul_(lam**0.5)
        k = self._cross(x)
        prior = self.kernel.diagonal(x) * (1.0 + self.jitter)
        e = self.Q @ k
        gamma = (prior - k @ e).clamp_min(self.jitter * prior)
        Se = self.Sigma @ e
        variance = gamma + e @ Se
        innovation = y - e @ self.mu
        D = self.noise_variance + variance
        nis = innovation.square().mean() / D

        # always take the point in, at the free slot; then prune if it was not novel or one is too much
        new = int((~self.active).to(torch.uint8).argmax())
        p = e.clone()
        p[new] = -1.0
        column = Se.clone()
        column[new] = variance
        self.basis[new], self.active[new] = x, True
        self.Q += torch.outer(p, p) / gamma
        self.mu[new] = e @ self.mu
        self.Sigma[new], self.Sigma[:, new] = column, column
        self.mu += torch.outer(column, innovation) / D
        self.Sigma -= torch.outer(column, column) / D
        novel = bool(gamma > 10 * self.jitter * prior)
        full = int(self.active.sum()) > self.capacity
        if full or not novel:
            self._prune(None if novel else new)
        kind = UpdateEvent.ABSORBED if not novel else UpdateEvent.REPLACED if full else UpdateEvent.ADDED
        event = torch.tensor(int(kind), device=self.device)
        return UpdateReport(event, gamma / prior, nis, torch.ones_like(gamma))

    def _prune(self, i: int | None) -> None:
        if i is None:
            error = ((self.Q @ self.mu) / self.Q.diagonal()[:, None]).square().sum(-1)
            i = int(torch.where(self.active, error, torch.inf).argmin())
        q = self.Q[:, i].clone()
        self.Q -= torch.outer(q, q) / q[i]
        self.active[i] = False
        for matrix in (self.Q, self.Sigma):
            matrix[i] = 0.0
            matrix[:, i] = 0.0
        self.mu[i] = 0.0

    def _cross(self, z: Tensor) -> Tensor:
        return self.kernel.vector(z, self.basis) * self.active
