from __future__ import annotations

import math
from abc import abstractmethod
from typing import Any

import torch
from torch.distributions import Normal

from ...typing import Bool, Float, Tensor
from ..base import ResidualLearner
from ..derivatives import value_and_jacobian
from ..recent import Recent
from ..report import UpdateReport
from ..running_scale import BLOCK
from ..sparse_gp.monitor import Misled
from ..sparse_gp.units import Standardize

_FAR = 2.3  # logarithm of a change of units after which a learner starts again
_CUT = 6.0  # largest target in its own units


class ScaledLearner(ResidualLearner):
    """``g(x) = scale_y f((x - shift) / scale_x) + offset``, f learned where x and y are of the order of 1.

    Units are those of :class:`~torch_ekm.residual.running_scale.RunningScale`. They are adopted after 1, 2,
    4, 8, 16 samples, which are then learned again, and from 32 samples on every 32, by what a subclass does
    in ``_follow``; after a change by a factor of ten the last 31 are learned again. Targets beyond 6 units
    count as 6: one outlier does not spoil a learner that trusts all samples alike. A learner that
    errs by four times y in most of sixteen samples starts again.

    A subclass implements f: ``_mean``, ``_law``, ``_slopes``, ``_learn``, ``_clear`` and ``_follow``.

    Args:
        standardize: whether it learns units, or how; else x and y are taken as they are.
        options: see ResidualLearner.
    """

    settled = 0.1  #: relative change of units that is not worth adopting
    grows = False  #: whether f grows with x without end

    def __init__(
        self, in_features: int, out_features: int, *, standardize: bool | Standardize = True, **options: Any
    ) -> None:
        super().__init__(in_features, out_features, **options)
        self.standardize, self.n_samples = bool(standardize), 0
        fleet = {"batch_shape": self.batch_shape, "dtype": self.dtype, "device": self.device}
        units = standardize if isinstance(standardize, Standardize) else Standardize()
        columns = [True] * self.in_features, [self.grows and self.standardize] * self.in_features
        self.units = units.units(self.in_features, self.out_features, *columns, **fleet)
        self.recent = Recent(self.in_features, self.out_features, BLOCK, **fleet)
        self.misled = Misled(self._like.new_zeros(self.batch_shape))

    # -- f, in its own units --------------------------------------------------------------------

    @abstractmethod
    def _mean(self, z: Tensor) -> Tensor:
        """f(z)."""

    @abstractmethod
    def _law(self, z: Tensor, observation: bool) -> tuple[Tensor, Tensor]:
        """Mean and variance of f(z), or of t."""

    def _slopes(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """f(z) and df/dz ``(*any, out, in)``; autograd here."""
        with self.lock:
            mean, slope = value_and_jacobian(self._mean, z)
        return mean, z.new_zeros(*mean.shape, z.shape[-1]) if slope is None else slope

    def _slope_variance(self, z: Tensor) -> Tensor:
        """Of each column of df/dz, ``(*any, in)``; NaN: not stated."""
        return torch.full_like(z, math.nan)

    @abstractmethod
    def _learn(self, z: Tensor, t: Tensor, mask: Bool[Tensor, "*batch"] | None) -> UpdateReport:
        """One sample per model."""

    @abstractmethod
    def _clear(self, models: Bool[Tensor, "*batch"] | None = None) -> None:
        """f as it was made, of all models or of these."""

    @abstractmethod
    def _follow(self, change: tuple[Tensor, Tensor], change_t: tuple[Tensor, Tensor]) -> None:
        """f in new units: ``new z = (z + offset) ratio``, and t the same."""

    # -- g, in those of x and y -----------------------------------------------------------------

    def forward(self, x: Tensor) -> Tensor:
        return self._value(self._mean(self._inputs(self.check_query(x))))

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """Mean and deviation of g, or of y."""
        mean, variance = self._law(self._inputs(self.check_query(x)), observation)
        deviation = variance.sqrt().expand_as(mean) * self.units.output.scale
        return Normal(self._value(mean), deviation.to(self.dtype), validate_args=False)

    def linearize(self, x: Tensor) -> tuple[Tensor, Tensor]:
        z = self._inputs(self.check_query(x))
        mean, slope = self._slopes(z)
        mean, slope = self.units.value(mean, 1), self.units.slope(slope, 1, z)
        return self.bounded_slope(mean.to(self.dtype), slope.to(self.dtype))

    def slope_deviation(self, x: Tensor) -> Tensor:
        """Of the same for all outputs, but for their scales."""
        z = self._inputs(self.check_query(x))
        deviation = self._slope_variance(z).clamp_min(0.0).sqrt().unsqueeze(-2)
        deviation = self.units.slope(deviation, 1, torch.zeros_like(z))
        return deviation.expand(*deviation.shape[:-2], self.out_features, -1).to(self.dtype)

    def reset(self) -> None:
        """Forget all samples and the units that were found in them."""
        for count in (self.n_refused, self.largest):
            count.zero_()
        self.n_samples = 0
        self.misled.level.zero_()
        self._clear()
        self.units.reset()
        self.recent.reset()

    def absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        if self.standardize:
            self._observe(x, y, mask)
        self.n_samples += 1
        z, t = self._inputs(x), self.units.output(y)
        self.misled.observe(t - self._mean(z), t, mask)
        misled = self.misled.found()
        if misled is not None:
            self._clear(misled)
            self.units.output.forget(misled)
            self.recent.on.masked_fill_(misled.unsqueeze(-1), 0.0)
        return self._learn(z, self._targets(y), mask)

    def _observe(self, x: Tensor, y: Tensor, mask: Tensor | None) -> None:
        n, on = self.n_samples, None if mask is None else mask.to(x.dtype)
        units, recent = self.units, self.recent
        recent.keep(n, x, y, on)
        if n + 1 < BLOCK and n & (n + 1) == 0:
            x, y, on, _ = recent.last(n + 1, n + 1)
            units.input.settle(x, on)
            units.output.settle(y, on)
            self._learn_block(n)
        elif (n + 1) % BLOCK == 0:
            units.pool(recent.x, recent.y, recent.on)
            pairs = [
                one.settle(settled=self.settled) or (torch.zeros_like(one.scale), torch.ones_like(one.scale))
                for one in (units.input, units.output)
            ]
            ratios = torch.cat([ratio for _, ratio in pairs], dim=-1).log().abs()
            if bool((ratios > 0).any() or (pairs[0][0] != 0).any() or (pairs[1][0] != 0).any()):
                self._follow(*pairs)
            far = (ratios > _FAR).any(-1)
            if bool(far.any()):  # what was learned so far was of another order
                self._learn_block(BLOCK - 1, far)

    def _learn_block(self, n: int, models: Bool[Tensor, "*batch"] | None = None) -> None:
        """Again, from the first n samples of the present block only; all models, or these."""
        self._clear(models)
        for i in range(n):
            on = self.recent.on[..., i] > 0
            on = on if models is None else on & models
            if not bool(on.any()):  # nothing, or of a time that is forgotten
                continue
            x, y = self.recent.x[..., i, :], self.recent.y[..., i, :]
            self._learn(self._inputs(x), self._targets(y), on if self.batch_shape else None)

    def _inputs(self, x: Float[Tensor, "*any in"]) -> Tensor:
        return self.units.input(x)

    def _targets(self, y: Float[Tensor, "*batch out"]) -> Tensor:
        return self.units.output(y).clamp(-_CUT, _CUT) if self.standardize else y

    def _value(self, mean: Float[Tensor, "*any out"]) -> Tensor:
        return self.bounded(self.units.value(mean, 1).to(self.dtype))

    def get_extra_state(self) -> dict[str, Any]:
        """Number of samples seen: the rhythm continues after a reload."""
        return {**super().get_extra_state(), "n_samples": self.n_samples}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self.n_samples = int(state["n_samples"])
