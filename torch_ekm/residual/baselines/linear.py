"""Bayesian linear regression on features, one sample at a time."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from ..._checks import check_count, check_fraction, check_positive
from ..._recorded import precision_problems
from ...typing import Bool, Float, Tensor
from ..base import joint_draws
from ..kernels.kernel import log_parameter
from ..report import UpdateReport
from ..running_scale import BLOCK
from .scaled import ScaledLearner


class LinearInFeatures(ScaledLearner):
    """``g(x) = w' phi(x)``, ``w ~ N(0, v I)``, ``y = g + noise``: exact posterior, O(f^2) a sample::

        P = (A/s2 + I/v)^-1,  w = P b/s2,   A = sum lam^(t-i) phi phi',  b = sum lam^(t-i) phi y'

    (A, b) is the master copy, (P, w) is carried along by rank-one steps and rebuilt every
    ``refresh_every`` samples, when forgetting is applied: unlike the classical P/lam, directions
    without new samples go back to the prior instead of winding up.

    Args:
        n_phi: number of features f.
        noise_variance, weight_variance: s2 and v.
        forgetting_factor: lam in (0, 1], see ForgettingFactor.
        robust: c of the weight ``1 / (1 + z2/c^2)`` on a sample's noise; None: weight 1.
        options: see ScaledLearner and ResidualLearner.
    """

    refresh_every = 16  #: samples between two rebuilds

    def __init__(
        self,
        in_features: int,
        out_features: int,
        n_phi: int,
        *,
        noise_variance: float = 0.1,
        weight_variance: float = 1.0,
        forgetting_factor: float = 1.0,
        robust: float | None = None,
        **options: Any,
    ) -> None:
        super().__init__(in_features, out_features, **options)
        self.noise_variance = check_positive("noise_variance", noise_variance)
        self.weight_variance = check_positive("weight_variance", weight_variance)
        self.forgetting_factor = check_fraction("forgetting_factor", forgetting_factor)
        self.robust = None if robust is None else check_positive("robust", robust)
        f, zeros = n_phi, self._like.new_zeros
        self.information = nn.Buffer(zeros(*self.batch_shape, f, f))
        self.target = nn.Buffer(zeros(*self.batch_shape, f, self.out_features))
        prior = self.weight_variance * torch.eye(f, dtype=self.dtype, device=self.device)
        self.covariance = nn.Buffer(prior.expand(*self.batch_shape, f, f).clone())
        self.weights = nn.Buffer(zeros(*self.batch_shape, f, self.out_features))
        self.pending = nn.Buffer(zeros(self.batch_shape))

    def state_problems(self, state: Mapping[str, Any]) -> list[str]:
        """What is wrong with the matrices of a state that is to be loaded."""
        return precision_problems("information", state["information"])

    @abstractmethod
    def features(self, x: Float[Tensor, "*any in"]) -> Float[Tensor, "*any f"]:
        """phi(x) of inputs in the learner's units, differentiable in x."""

    def _mean(self, z: Tensor) -> Tensor:
        return (self.features(z).unsqueeze(-2) @ self.weights).squeeze(-2)

    def _law(self, z: Tensor, observation: bool) -> tuple[Tensor, Tensor]:
        """Variance ``phi' P phi``, plus s2 on request; the same for all outputs."""
        phi = self.features(z).unsqueeze(-2)
        v = (phi @ self.covariance @ phi.mT).squeeze(-1).clamp_min(torch.finfo(phi.dtype).tiny)
        return (phi @ self.weights).squeeze(-2), v + self.noise_variance if observation else v

    def unit_draws(self, x: Tensor, n: int, generator: torch.Generator | None) -> Tensor:
        """From the covariance ``phi' P phi`` of the queries."""
        z = self._inputs(x).reshape(-1, *self.batch_shape, self.in_features).movedim(0, -2)
        phi = self.features(z)
        draws = joint_draws(phi @ self.covariance @ phi.mT, n, self.out_features, generator)
        return draws.reshape(n, *x.shape[:-1], self.out_features)

    @abstractmethod
    def _feature_slopes(self, z: Tensor) -> Float[Tensor, "*any f in"]:
        """dphi/dz."""

    def _slopes(self, z: Tensor) -> tuple[Tensor, Tensor]:
        return self._mean(z), self.weights.mT @ self._feature_slopes(z)

    def _slope_variance(self, z: Tensor) -> Tensor:
        """``(dphi/dz)' P dphi/dz`` by column."""
        slopes = self._feature_slopes(z)
        return (slopes * (self.covariance @ slopes)).sum(-2)

    def _clear(self, models: Bool[Tensor, "*batch"] | None = None) -> None:
        """Back to w ~ N(0, v I)."""
        models = torch.ones_like(self.pending, dtype=torch.bool) if models is None else models
        self.pending.masked_fill_(models, 0.0)
        models = models[..., None, None]
        for buffer in (self.information, self.target, self.weights, self.covariance):
            buffer.masked_fill_(models, 0.0)
        prior = self.weight_variance * models.squeeze(-1)
        self.covariance.diagonal(dim1=-2, dim2=-1).add_(prior)

    def _learn(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        s2, column = self.noise_variance, self.features(x).unsqueeze(-1)
        Pphi = self.covariance @ column
        v = (column.mT @ Pphi).squeeze(-1).squeeze(-1)
        innovation = y - (column.mT @ self.weights).squeeze(-2)
        nis = innovation.square().mean(-1) / (s2 + v)
        weight = torch.ones_like(v)
        if self.robust is not None:
            weight = 1.0 / (1.0 + nis / self.robust**2)
        gain, share = 1.0 / (s2 / weight + v), weight
        if mask is not None:
            gain, share = gain * mask, share * mask
        gain, share = gain[..., None, None], share[..., None, None]
        self.covariance -= gain * (Pphi @ Pphi.mT)
        self.weights += gain * (Pphi @ innovation.unsqueeze(-2))
        self.information += share * (column @ column.mT)
        self.target += share * (column @ y.unsqueeze(-2))
        self.pending += 1.0 if mask is None else mask
        if self.n_samples % self.refresh_every == 0:
            self._rebuild()
        return UpdateReport.of(nis, mask, weight=weight)

    def _rebuild(self) -> None:
        """Forget what is due; (P, w) from (A, b) by Cholesky in double precision."""
        if self.forgetting_factor < 1.0:
            factor = (self.forgetting_factor**self.pending)[..., None, None]
            self.information.mul_(factor)
            self.target.mul_(factor)
        self.pending.zero_()
        precision = self.information.double() / self.noise_variance
        precision.diagonal(dim1=-2, dim2=-1).add_(1.0 / self.weight_variance)
        # with a unit diagonal, and what rounding takes from it: inputs may be far from 0 and large
        d = precision.diagonal(dim1=-2, dim2=-1).rsqrt()
        precision = d.unsqueeze(-1) * precision * d.unsqueeze(-2)
        precision.diagonal(dim1=-2, dim2=-1).add_(d.shape[-1] * torch.finfo(d.dtype).eps)
        factor = torch.linalg.cholesky_ex(precision)[0]
        self.covariance.copy_(d.unsqueeze(-1) * torch.cholesky_inverse(factor) * d.unsqueeze(-2))
        target = d.unsqueeze(-1) * self.target.double() / self.noise_variance
        self.weights.copy_(d.unsqueeze(-1) * torch.cholesky_solve(target, factor))


class RecursiveLeastSquares(LinearInFeatures):
    """``g(x) = W' [x, 1]``: Bayesian recursive least squares with forgetting.

    Args:
        options: see LinearInFeatures.
    """

    grows = True

    def __init__(self, in_features: int, out_features: int, **options: Any) -> None:
        super().__init__(in_features, out_features, in_features + 1, **options)

    def features(self, x: Tensor) -> Tensor:
        return torch.cat([x, torch.ones_like(x[..., :1])], dim=-1)

    def _feature_slopes(self, z: Tensor) -> Tensor:
        """The identity, and 0 for the constant."""
        slopes = torch.eye(self.in_features + 1, self.in_features, dtype=z.dtype, device=z.device)
        return slopes.expand(*z.shape[:-1], *slopes.shape)

    def _follow(self, change: tuple[Tensor, Tensor], change_t: tuple[Tensor, Tensor]) -> None:
        """``new phi = T phi``: ``A <- T A T'``, ``b <- T (b + A 1 o) r``, 1 being the bias' place."""
        (offset, ratio), (offset_t, ratio_t) = change, change_t
        T = torch.diag_embed(torch.cat([ratio, torch.ones_like(ratio[..., :1])], -1))
        T[..., :-1, -1] = offset * ratio
        self.target += self.information[..., -1:] * offset_t.unsqueeze(-2)
        self.information.copy_(T @ self.information @ T.mT)
        self.target.copy_(T @ self.target * ratio_t.unsqueeze(-2))
        self._rebuild()


class RandomFeatureRLS(LinearInFeatures):
    """``phi(x) = sqrt(1/D) [cos(Omega x), sin(Omega x)]``: a squared exponential GP, approximately.

    Incremental sparse-spectrum regression after Gijsberts & Metta (Neural Networks 41, 2013); the
    frequencies Omega ~ N(0, L^-2) stay fixed.

    Args:
        n_frequencies: D; there are 2 D features.
        lengthscale: L, one number or one per input; default sqrt(in_features).
        seed: of the frequencies.
        options: see LinearInFeatures.
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        n_frequencies: int = 100,
        lengthscale: float | Tensor | None = None,
        seed: int = 0,
        **options: Any,
    ) -> None:
        n_phi = 2 * check_count("n_frequencies", n_frequencies)
        super().__init__(in_features, out_features, n_phi, **options)
        generator = torch.Generator().manual_seed(seed)
        draws = torch.randn(n_frequencies, in_features, generator=generator, dtype=torch.float64)
        lengthscale = math.sqrt(in_features) if lengthscale is None else lengthscale
        scale = log_parameter("lengthscale", lengthscale, (self.in_features,), dtype=torch.float64).exp()
        self.frequencies = nn.Buffer((draws / scale).to(self._like))

    def features(self, x: Tensor) -> Tensor:
        angle = x @ self.frequencies.mT
        return torch.cat([angle.cos(), angle.sin()], dim=-1) / math.sqrt(len(self.frequencies))

    settled = 1.0  # frequencies are of one unit: only a much better one is worth starting again

    def _follow(self, change: tuple[Tensor, Tensor], change_t: tuple[Tensor, Tensor]) -> None:
        """Features of other units are others: the block is learned again, but for the sample that comes."""
        self._learn_block(BLOCK - 1)

    def _feature_slopes(self, z: Tensor) -> Tensor:
        """``dphi/dz = sqrt(1/D) [-sin(.) Omega; cos(.) Omega]``."""
        cos, sin = self.features(z).chunk(2, dim=-1)
        return torch.cat([-sin, cos], dim=-1).unsqueeze(-1) * self.frequencies.repeat(2, 1)
