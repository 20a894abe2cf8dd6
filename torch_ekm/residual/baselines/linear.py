"""Bayesian linear regression, one sample at a time."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torch.distributions import Normal

from ..._checks import check_fraction, check_positive
from ...typing import Bool, Float, Tensor
from ..base import ResidualLearner
from ..misled import Misled
from ..predictions import joint_draws
from ..recent import Recent
from ..report import UpdateReport
from ..running_scale import BLOCK
from ..sparse_gp.units import Standardize

_FAR = 2.3  # logarithm of a change of units after which it starts again
_CUT = 6.0  # largest target in its own units


class RecursiveLeastSquares(ResidualLearner):
    """``g(x) = W' [z, 1]``: Bayesian recursive least squares with forgetting, O(d^2) a sample::

        P = (A/s2 + I/v)^-1,  W = P b/s2,   A = sum lam^(t-i) phi phi',  b = sum lam^(t-i) phi y'

    ``phi = [z, 1]``, z and y in units of :class:`~torch_ekm.residual.running_scale.RunningScale`, W of prior
    N(0, v I). (A, b) is the master copy, (P, W) is carried along by rank-one steps and rebuilt every
    ``refresh_every`` samples, when forgetting is applied: unlike the classical P/lam, directions
    without new samples go back to the prior instead of winding up.

    Units are adopted after 1, 2, 4, 8, 16 samples, which are then learned again, and from 32 samples on every
    32; after a change by a factor of ten the last 31 are learned again. Targets beyond 6 units count as 6:
    one outlier does not spoil a learner that trusts all samples alike. A learner that errs by four times y in
    most of sixteen samples starts again.

    Args:
        noise_variance, weight_variance: s2 and v.
        forgetting_factor: lam in (0, 1], see ForgettingFactor.
        robust: c of the weight ``1 / (1 + z2/c^2)`` on a sample's noise; None: weight 1.
        standardize: whether it learns units, or how; else x and y are taken as they are.
        options: see ResidualLearner.
    """

    refresh_every = 16  #: samples between two rebuilds

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        noise_variance: float = 0.1,
        weight_variance: float = 1.0,
        forgetting_factor: float = 1.0,
        robust: float | None = None,
        standardize: bool | Standardize = True,
        **options: Any,
    ) -> None:
        super().__init__(in_features, out_features, **options)
        self.noise_variance = check_positive("noise_variance", noise_variance)
        self.weight_variance = check_positive("weight_variance", weight_variance)
        self.forgetting_factor = check_fraction("forgetting_factor", forgetting_factor)
        self.robust = None if robust is None else check_positive("robust", robust)
        self.standardize, self.n_samples = bool(standardize), 0
        fleet = {"batch_shape": self.batch_shape, "dtype": self.dtype, "device": self.device}
        units = standardize if isinstance(standardize, Standardize) else Standardize()
        columns = [True] * self.in_features, [self.standardize] * self.in_features
        self.units = units.units(self.in_features, self.out_features, *columns, **fleet)
        self.recent = Recent(self.in_features, self.out_features, BLOCK, **fleet)
        self.misled = Misled(tuple(self.batch_shape), self._kept, self.device)
        f, zeros = self.in_features + 1, self._like.new_zeros
        self.information = nn.Buffer(zeros(*self.batch_shape, f, f))
        self.target = nn.Buffer(zeros(*self.batch_shape, f, self.out_features))
        self.covariance = nn.Buffer(zeros(*self.batch_shape, f, f))
        self.weights = nn.Buffer(zeros(*self.batch_shape, f, self.out_features))
        self.pending = nn.Buffer(zeros(self.batch_shape))
        self._clear(torch.ones_like(self.pending, dtype=torch.bool))

    def features(self, z: Float[Tensor, "*any in"]) -> Float[Tensor, "*any f"]:
        """``[z, 1]``."""
        return torch.cat([z, torch.ones_like(z[..., :1])], dim=-1)

    # -- predictions ----------------------------------------------------------------------------

    def forward(self, x: Tensor) -> Tensor:
        return self._value(self._mean(self.units.input(self.check_query(x))))

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """Variance ``phi' P phi``, plus s2 on request; the same for all outputs but for their scales."""
        z = self.units.input(self.check_query(x))
        phi, mean = self.features(z).unsqueeze(-2), self._mean(z)
        v = (phi @ self.covariance @ phi.mT).squeeze(-1).clamp_min(torch.finfo(phi.dtype).tiny)
        variance = v + self.noise_variance if observation else v
        deviation = variance.sqrt().expand_as(mean) * self.units.output.scale
        return Normal(self._value(mean), deviation.to(self.dtype), validate_args=False)

    def linearize(self, x: Tensor) -> tuple[Tensor, Tensor]:
        z = self.units.input(self.check_query(x))
        slope = self.weights[..., :-1, :].mT.expand(*z.shape[:-1], -1, -1)
        mean, slope = self.units.value(self._mean(z), 1), self.units.slope(slope, 1, z)
        return self.bounded_slope(mean.to(self.dtype), slope.to(self.dtype))

    def slope_deviation(self, x: Tensor) -> Tensor:
        """Root of P's diagonal; the same for all outputs but for their scales."""
        z = self.units.input(self.check_query(x))
        variance = self.covariance.diagonal(dim1=-2, dim2=-1)[..., :-1].expand_as(z)
        deviation = self.units.slope(variance.clamp_min(0.0).sqrt().unsqueeze(-2), 1, torch.zeros_like(z))
        return deviation.expand(*deviation.shape[:-2], self.out_features, -1).to(self.dtype)

    def unit_draws(self, x: Tensor, n: int, generator: torch.Generator | None) -> Tensor:
        """From the covariance ``phi' P phi`` of the queries."""
        z = self.units.input(x).reshape(-1, *self.batch_shape, self.in_features).movedim(0, -2)
        phi = self.features(z)
        draws = joint_draws(phi @ self.covariance @ phi.mT, n, self.out_features, generator)
        return draws.reshape(n, *x.shape[:-1], self.out_features)

    def _mean(self, z: Float[Tensor, "*any in"]) -> Float[Tensor, "*any out"]:
        """In the learner's units."""
        return (self.features(z).unsqueeze(-2) @ self.weights).squeeze(-2)

    def _value(self, mean: Float[Tensor, "*any out"]) -> Tensor:
        return self.bounded(self.units.value(mean, 1).to(self.dtype))

    # -- learning -------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget all samples and the units that were found in them."""
        for count in (self.n_refused, self.largest, self.misled.level):
            count.zero_()
        self.n_samples = 0
        self._clear(torch.ones_like(self.pending, dtype=torch.bool))
        self.units.reset()
        self.recent.reset()

    def absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        if self.standardize:
            self._observe(x, y, mask)
        self.n_samples += 1
        z, t = self.units.input(x), self.units.output(y)
        self.misled.observe(t - self._mean(z), t, mask)
        misled = self.misled.found()
        if misled is not None:
            self._clear(misled)
            self.units.output.forget(misled)
            self.recent.on.masked_fill_(misled.unsqueeze(-1), 0.0)
        return self._learn(x, y, mask)

    def _observe(self, x: Tensor, y: Tensor, mask: Tensor | None) -> None:
        """Units, before the sample that comes is learned in them."""
        n, units, recent = self.n_samples, self.units, self.recent
        recent.keep(n, x, y, None if mask is None else mask.to(x.dtype))
        if n + 1 < BLOCK and n & (n + 1) == 0:
            x, y, on, _ = recent.last(n + 1, n + 1)
            units.input.settle(x, on)
            units.output.settle(y, on)
            self._learn_block(n, torch.ones_like(self.pending, dtype=torch.bool))
        elif (n + 1) % BLOCK == 0:
            units.pool(recent.x, recent.y, recent.on)
            changes = units.input.settle(), units.output.settle()
            ratios = torch.cat([changes[0][1], changes[1][1]], dim=-1).log().abs()
            if bool((ratios > 0).any() or (changes[0][0] != 0).any() or (changes[1][0] != 0).any()):
                self._follow(*changes)
            far = (ratios > _FAR).any(-1)
            if bool(far.any()):  # what was learned so far was of another order
                self._learn_block(BLOCK - 1, far)

    def _learn_block(self, n: int, models: Bool[Tensor, "*batch"]) -> None:
        """Again, from the first n samples of the present block only."""
        self._clear(models)
        for i in range(n):
            on = (self.recent.on[..., i] > 0) & models
            if bool(on.any()):  # else it is nothing, or of a time that is forgotten
                x, y = self.recent.x[..., i, :], self.recent.y[..., i, :]
                self._learn(x, y, on if self.batch_shape else None)

    def _learn(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        s2, column = self.noise_variance, self.features(self.units.input(x)).unsqueeze(-1)
        t = self.units.output(y).clamp(-_CUT, _CUT) if self.standardize else y
        Pphi = self.covariance @ column
        v = (column.mT @ Pphi).squeeze(-1).squeeze(-1)
        innovation = t - (column.mT @ self.weights).squeeze(-2)
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
        self.target += share * (column @ t.unsqueeze(-2))
        self.pending += 1.0 if mask is None else mask
        if self.n_samples % self.refresh_every == 0:
            self._rebuild()
        return UpdateReport.of(nis, mask, weight=weight)

    def _rebuild(self) -> None:
        """Forget what is due; (P, W) from (A, b) by Cholesky in double precision."""
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

    def _follow(self, change: tuple[Tensor, Tensor], change_t: tuple[Tensor, Tensor]) -> None:
        """New units, ``new phi = T phi``: ``A <- T A T'``, ``b <- T (b + A 1 o) r``, 1 the bias' place."""
        (offset, ratio), (offset_t, ratio_t) = change, change_t
        T = torch.diag_embed(torch.cat([ratio, torch.ones_like(ratio[..., :1])], -1))
        T[..., :-1, -1] = offset * ratio
        self.target += self.information[..., -1:] * offset_t.unsqueeze(-2)
        self.information.copy_(T @ self.information @ T.mT)
        self.target.copy_(T @ self.target * ratio_t.unsqueeze(-2))
        self._rebuild()

    def _clear(self, models: Bool[Tensor, "*batch"]) -> None:
        """These models back to W ~ N(0, v I)."""
        self.pending.masked_fill_(models, 0.0)
        models = models[..., None, None]
        for buffer in (self.information, self.target, self.weights, self.covariance):
            buffer.masked_fill_(models, 0.0)
        self.covariance.diagonal(dim1=-2, dim2=-1).add_(self.weight_variance * models.squeeze(-1))

    def get_extra_state(self) -> dict[str, Any]:
        """Number of samples seen: the rhythm continues after a reload."""
        return {**super().get_extra_state(), "n_samples": self.n_samples}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self.n_samples = int(state["n_samples"])
