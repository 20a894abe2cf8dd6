"""The units in which a learner works, learned from the first samples of a stream."""

from __future__ import annotations

import torch
from torch import nn

from ...typing import Float, Tensor
from ..checks import check_count
from .part import Host, Part, Sample, Units


class Standardize(Part, Units):
    """``z = (x - shift) / scale_x``, ``t = y / scale_y``, learned from the first samples.

    Inputs are centred where the kernel is shift invariant; outputs are only scaled, so that 0 stays 0.

    New units are adopted when the caches are rebuilt, which happens after 1, 2, 4, 8, ... samples too, since
    units are rough at first.

    Args:
        samples: after so many the units stand still.

    Raises:
        ParameterError: not a positive integer.
    """

    def __init__(self, samples: int = 1000) -> None:
        super().__init__()
        self.samples = check_count("samples", samples)

    def bind(self, learner: Host) -> None:
        """Running moments of x and y."""
        like = learner.posterior.basis
        fleet = {"batch_shape": learner.posterior.batch_shape, "dtype": like.dtype, "device": like.device}
        shifted = learner.kernel.shift_invariant(learner.in_features)
        self.input = RunningScale(learner.in_features, shifted, **fleet)
        self.output = RunningScale(learner.out_features, **fleet)

    def inputs(self, x: Tensor) -> Tensor:
        return self.input(x)

    def targets(self, y: Tensor) -> Tensor:
        return y / self.output.scale

    def of_sets(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        z = (x - self.input.shift.unsqueeze(-2)) / self.input.scale.unsqueeze(-2)
        return z, y / self.output.scale.unsqueeze(-2)

    def sets_as_given(self, z: Tensor) -> Tensor:
        return z * self.input.scale.unsqueeze(-2) + self.input.shift.unsqueeze(-2)

    def value(self, value: Tensor, power: int) -> Tensor:
        return value * self._scale(power)

    def slope(self, slope: Tensor, power: int) -> Tensor:
        first = self.input.scale.shape[-1] - slope.shape[-1]
        return slope * self._scale(power).unsqueeze(-1) / self.input.scale[..., None, first:]

    def curvature(self, curvature: Tensor) -> Tensor:
        inverse = 1.0 / self.input.scale[..., self.input.scale.shape[-1] - curvature.shape[-1] :]
        scaled = curvature * (inverse.unsqueeze(-1) * inverse.unsqueeze(-2)).unsqueeze(-3)
        return scaled * self._scale(2)[..., None, None]

    def _scale(self, power: int) -> Tensor:
        return self.output.scale if power == 1 else self.output.scale.square()

    def affine(self) -> tuple[Tensor, ...]:
        return self.input.shift, self.input.scale, self.output.shift, self.output.scale

    def after_update(self, learner: Host, sample: Sample) -> bool:
        """Take x in where there is a sample, y with the sample's weight too."""
        n = learner.n_samples
        if n <= self.samples:
            weight = sample.report.weight
            used = torch.ones_like(weight) if sample.mask is None else sample.mask
            self.input.observe(sample.x, used)
            self.output.observe(sample.y, weight * used)
        return n < self.samples and (n + 1) & n == 0

    def on_rebuild(self, learner: Host) -> None:
        """Adopt the moments: ``new z = (old z + offset) ratio``, ``new t = old t ratio_t``."""
        if learner.n_samples <= self.samples:
            offset, ratio = self.input.settle()
            ratio_t = self.output.settle()[1]
            learner.posterior.basis.add_(offset.unsqueeze(-2)).mul_(ratio.unsqueeze(-2))
            learner.posterior.information.mul_(ratio_t.unsqueeze(-2))

    def reset(self) -> None:
        """Back to z = x, t = y."""
        self.input.reset()
        self.output.reset()


class RunningScale(nn.Module):
    """``z = (x - shift) / scale`` from running moments; columns may be exempt from the shift.

    :meth:`observe` takes samples in, :meth:`settle` adopts the moments found so far. In between
    ``shift`` and ``scale`` stand still, so that what was computed with them stays valid. A column
    that has not varied keeps scale 1. Exempt columns are scaled by their root mean square.

    Args:
        features: width of x.
        shifted: columns that are centred (none by default).
        batch_shape: shape of the fleet.
    """

    def __init__(
        self,
        features: int,
        shifted: list[bool] | None = None,
        *,
        batch_shape: tuple[int, ...] = (),
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        shape = (*batch_shape, features)
        factory = {"dtype": dtype, "device": device}
        self.shift = nn.Buffer(torch.zeros(shape, **factory))
        self.scale = nn.Buffer(torch.ones(shape, **factory))
        self.total = nn.Buffer(torch.zeros(*batch_shape, 1, **factory))
        self.mean = nn.Buffer(torch.zeros(shape, **factory))
        self.spread = nn.Buffer(torch.zeros(shape, **factory))  # weighted sum of squares
        columns = torch.tensor(shifted or [False] * features, dtype=dtype, device=device)
        self.shifted = nn.Buffer(columns)

    def forward(self, x: Float[Tensor, "*batch features"]) -> Float[Tensor, "*batch features"]:
        """x, or its first columns, in the learner's units."""
        n = x.shape[-1]
        return (x - self.shift[..., :n]) / self.scale[..., :n]

    def observe(self, x: Float[Tensor, "*batch features"], weight: Float[Tensor, "*batch"]) -> None:
        """Add one weighted sample per model (West's update of mean and sum of squares)."""
        weight = weight.unsqueeze(-1)
        self.total += weight
        away = x - self.mean
        # Exempt columns keep mean 0: their spread is then the sum of squares about the origin.
        gain = weight / self.total.clamp_min(torch.finfo(x.dtype).tiny)
        self.mean += gain * away * self.shifted
        self.spread += weight * away * (x - self.mean)

    def settle(self) -> tuple[Tensor, Tensor]:
        """Adopt the moments; returns the change as ``(offset, ratio)``: new z = (old z + offset) * ratio."""
        variance = self.spread / self.total.clamp_min(torch.finfo(self.mean.dtype).tiny)
        floor = (100 * torch.finfo(self.mean.dtype).eps * self.mean).square()
        usable = (variance > floor) & (variance > torch.finfo(self.mean.dtype).tiny)
        scale = torch.where(usable, variance, 1.0).sqrt()
        offset, ratio = (self.shift - self.mean) / self.scale, self.scale / scale
        self.shift.copy_(self.mean)
        self.scale.copy_(scale)
        return offset, ratio

    def reset(self) -> None:
        """Back to z = x."""
        for buffer in (self.shift, self.total, self.mean, self.spread):
            buffer.zero_()
        self.scale.fill_(1.0)

    def extra_repr(self) -> str:
        return f"features={self.scale.shape[-1]}, shifted={self.shifted.bool().tolist()}"
