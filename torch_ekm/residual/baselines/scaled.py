from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch.distributions import Normal

from ..._checks import check_sizes
from ...exceptions import ParameterError
from ...typing import Bool, Float, Tensor
from ..base import ResidualLearner
from ..misled import Misled
from ..report import UpdateReport
from ..running_scale import BLOCK, RunningScale, Units

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
        standardize: whether it learns units; else x and y are taken as they are.
        output_offset: ``"zero"``, or ``"learned"``: y is centred too.
        input_resolution, output_scale: sizes below which x and y mean nothing, see Standardize.
        options: see ResidualLearner.
    """

    settled = 0.1  #: relative change of units that is not worth adopting

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        standardize: bool = True,
        output_offset: Literal["zero", "learned"] = "zero",
        input_resolution: float | Sequence[float] = 0.0,
        output_scale: float | Sequence[float] = 0.0,
        **options: Any,
    ) -> None:
        super().__init__(in_features, out_features, **options)
        if output_offset not in ("zero", "learned"):
            raise ParameterError("output_offset", output_offset, "'zero' or 'learned'")
        self.standardize, self.output_offset = bool(standardize), output_offset
        self._least = (
            check_sizes("input_resolution", input_resolution, in_features),
            check_sizes("output_scale", output_scale, out_features),
        )
        self.misled = Misled(tuple(self.batch_shape), self._kept, self.device)
        self.n_samples = 0

    def _make_units(self, shifted: list[bool], dtype: torch.dtype, grows: list[bool] | None = None) -> None:
        """Last in a constructor."""
        options = {"batch_shape": self.batch_shape, "dtype": dtype, "device": self.device}
        centred = [self.output_offset == "learned"] * self.out_features
        (resolution, least), grows = self._least, grows if self.standardize else None
        self.units = Units(
            RunningScale(self.in_features, shifted, grows, resolution, **options),
            RunningScale(self.out_features, centred, least=least, **options),
        )

    # -- f, in its own units --------------------------------------------------------------------

    @abstractmethod
    def _mean(self, z: Tensor) -> Tensor:
        """f(z)."""

    @abstractmethod
    def _law(self, z: Tensor, observation: bool) -> tuple[Tensor, Tensor]:
        """Mean and variance of f(z), or of t."""

    def _slopes(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """f(z) and df/dz; autograd here."""
        raise NotImplementedError

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
        if type(self)._slopes is ScaledLearner._slopes:
            return super().linearize(x)
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
        return self._learn(z, self._targets(y), mask)

    def _observe(self, x: Tensor, y: Tensor, mask: Tensor | None) -> None:
        n, on = self.n_samples, None if mask is None else mask.to(x.dtype)
        units = self.units
        units.observe(n % BLOCK, x, y, on)
        if n + 1 < BLOCK and n & (n + 1) == 0:
            units.input.settle(young=True)
            units.output.settle(young=True)
            self._learn_block(n)
        elif (n + 1) % BLOCK == 0:
            units.pool()
            changes = units.input.settle(settled=self.settled), units.output.settle(settled=self.settled)
            ratios = torch.cat([changes[0][1], changes[1][1]], dim=-1).log().abs()
            if bool((ratios > 0).any() or (changes[0][0] != 0).any() or (changes[1][0] != 0).any()):
                self._follow(*changes)
            far = (ratios > _FAR).any(-1)
            if bool(far.any()):  # what was learned so far was of another order
                self._learn_block(BLOCK - 1, far)

    def _learn_block(self, n: int, models: Bool[Tensor, "*batch"] | None = None) -> None:
        """Again, from the first n samples of the present block only; all models, or these."""
        self._clear(models)
        input, output = self.units.input, self.units.output
        for i in range(n):
            on = input.block_on[..., i, 0] * output.block_on[..., i, 0] > 0
            on = on if models is None else on & models
            if not bool(on.any()):  # nothing, or of a time that is forgotten
                continue
            x, y = input.block[..., i, :], output.block[..., i, :]
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
