from __future__ import annotations

from typing import Any

import torch
from torch import nn

from ..._checks import check_count, check_positive
from ...typing import Tensor
from ..kernels.kernel import Kernel
from ..kernels.stationary import Matern32
from ..report import UpdateReport
from .scaled import ScaledLearner


class WindowGP(ScaledLearner):
    """``mean = k'(K + s2 I)^-1 y``, ``var = k** - k'(K + s2 I)^-1 k`` on a sliding window.

    O(window^3) per sample: one Cholesky. What left the window is gone.

    Args:
        window: samples kept.
        kernel: default Matern 3/2 with lengthscale sqrt(in_features).
        noise_variance: s2.
        robust: c; a surprising sample gets the noise ``s2 (1 + z2/c^2)``.
        options: see ScaledLearner and ResidualLearner.
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        window: int = 100,
        kernel: Kernel | None = None,
        noise_variance: float = 0.1,
        robust: float | None = None,
        **options: Any,
    ) -> None:
        super().__init__(in_features, out_features, **options)
        self.window = check_count("window", window)
        self.noise_variance = check_positive("noise_variance", noise_variance)
        self.robust = None if robust is None else check_positive("robust", robust)
        fleet = {"batch_shape": self.batch_shape, "device": self.device, "dtype": self.dtype}
        self.kernel = Matern32(in_features, **fleet) if kernel is None else kernel.to(self._like)
        zeros, shape, n = self._like.new_zeros, self.batch_shape, self.window
        self.inputs = nn.Buffer(zeros(*shape, n, self.in_features))
        self.targets = nn.Buffer(zeros(*shape, n, self.out_features))
        self.noise = nn.Buffer(zeros(*shape, n))  # 0 where there is no sample
        self.count = nn.Buffer(torch.zeros(shape, dtype=torch.int64, device=self.device))
        self.solution = nn.Buffer(zeros(*shape, n, self.out_features))
        self.inverse = nn.Buffer(zeros(*shape, n, n))  # L^-1 of K + s2 I = LL'
        self._make_units(self.kernel.shift_invariant(self.in_features), self.dtype)

    def _mean(self, z: Tensor) -> Tensor:
        k = self.kernel.vector(z, self.inputs)
        return (k.unsqueeze(-2) @ self.solution).squeeze(-2)

    def _law(self, z: Tensor, observation: bool) -> tuple[Tensor, Tensor]:
        """``k** - |L^-1 k|^2``, plus s2 on request."""
        u = (self.inverse @ self.kernel.vector(z, self.inputs).unsqueeze(-1)).squeeze(-1)
        v = (self.kernel.diagonal(z) - u.square().sum(-1)).clamp_min(torch.finfo(z.dtype).eps)
        return self._mean(z), (v + self.noise_variance if observation else v).unsqueeze(-1)

    def _slopes(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """``dk/dx'(K + s2 I)^-1 y``."""
        k, dk = self.kernel.with_gradient(z, self.inputs)
        return (k.unsqueeze(-2) @ self.solution).squeeze(-2), self.solution.mT @ dk

    def _follow(self, change: tuple[Tensor, Tensor], change_t: tuple[Tensor, Tensor]) -> None:
        """The window in new units; its solution comes with the next sample."""
        for kept, (offset, ratio) in ((self.inputs, change), (self.targets, change_t)):
            kept.add_(offset.unsqueeze(-2)).mul_(ratio.unsqueeze(-2))

    def _learn(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        mean, variance = self._law(x, True)
        nis = ((y - mean) / variance.sqrt()).square().mean(-1)
        weight = torch.ones_like(nis)
        if self.robust is not None:
            weight = 1.0 / (1.0 + nis / self.robust**2)
        here = torch.arange(self.window, device=self.device) == (self.count % self.window).unsqueeze(-1)
        if mask is not None:
            here = here & mask.unsqueeze(-1)
        self.inputs.copy_(torch.where(here.unsqueeze(-1), x.unsqueeze(-2), self.inputs))
        self.targets.copy_(torch.where(here.unsqueeze(-1), y.unsqueeze(-2), self.targets))
        self.noise.copy_(torch.where(here, (self.noise_variance / weight).unsqueeze(-1), self.noise))
        self.count += 1 if mask is None else mask

        on = (self.noise > 0).to(x.dtype).unsqueeze(-1)
        K = (self.kernel(self.inputs, self.inputs) * (on * on.mT)).double()
        K = K + torch.diag_embed(torch.where(self.noise > 0, self.noise, 1.0)).double()
        L = torch.linalg.cholesky_ex(K)[0]
        inverse = torch.linalg.solve_triangular(L, torch.eye(self.window).to(L).expand_as(L), upper=False)
        inverse = inverse * on.mT.double()
        self.solution.copy_(inverse.mT @ (inverse @ self.targets.double()))
        self.inverse.copy_(inverse)
        novelty = (variance[..., 0] - self.noise_variance) / self.kernel.diagonal(x)
        return UpdateReport.of(nis, mask, novelty=novelty, weight=weight)
