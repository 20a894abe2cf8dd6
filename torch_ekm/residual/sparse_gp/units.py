"""The units in which a learner works, learned from the first samples of a stream."""

from __future__ import annotations

from typing import Any

from torch import nn

from ...typing import Float, Tensor
from .running_scale import RunningScale


class LearnedUnits(nn.Module):
    """``z = (x - shift) / scale_x``, ``t = y / scale_y``; outputs are not shifted, so that 0 stays 0.

    Args:
        in_features, out_features: widths of x and y.
        learn_for: samples after which the units stand still; 0: x and y are taken as they are.
        shifted: columns of x that are centred.
        fleet: batch_shape, dtype, device.
    """

    def __init__(
        self, in_features: int, out_features: int, learn_for: int, shifted: list[bool], **fleet: Any
    ) -> None:
        super().__init__()
        self.learn_for = learn_for
        self.input = RunningScale(in_features, shifted, **fleet)
        self.output = RunningScale(out_features, **fleet)

    def learning(self, n_samples: int) -> bool:
        """Whether the units still move after so many samples."""
        return n_samples <= self.learn_for and self.learn_for > 0

    def inputs(self, x: Float[Tensor, "*any columns"]) -> Float[Tensor, "*any columns"]:
        """x, or its first columns, in the learner's units."""
        return self.input(x) if self.learn_for else x

    def targets(self, y: Float[Tensor, "*any out"]) -> Float[Tensor, "*any out"]:
        """y in the learner's units."""
        return y / self.output.scale if self.learn_for else y

    def of_sets(
        self, x: Float[Tensor, "*batch n in"], y: Float[Tensor, "*batch n out"]
    ) -> tuple[Tensor, Tensor]:
        """n samples of each model in the learner's units."""
        if not self.learn_for:
            return x, y
        z = (x - self.input.shift.unsqueeze(-2)) / self.input.scale.unsqueeze(-2)
        return z, y / self.output.scale.unsqueeze(-2)

    def sets_as_given(self, z: Float[Tensor, "*batch n in"]) -> Float[Tensor, "*batch n in"]:
        """Inputs in the learner's units back in their own."""
        return z * self.input.scale.unsqueeze(-2) + self.input.shift.unsqueeze(-2)

    def value(self, value: Float[Tensor, "*any out_or_1"], power: int) -> Tensor:
        """An output in its own unit, or (power 2) a variance in its square."""
        return value * self._scale(power) if self.learn_for else value

    def slope(self, slope: Float[Tensor, "*any out_or_1 columns"], power: int) -> Tensor:
        """The derivative of such a value by the last columns of x."""
        if not self.learn_for:
            return slope
        first = self.input.scale.shape[-1] - slope.shape[-1]
        return slope * self._scale(power).unsqueeze(-1) / self.input.scale[..., None, first:]

    def _scale(self, power: int) -> Tensor:
        return self.output.scale if power == 1 else self.output.scale.square()

    def observe(self, x: Tensor, y: Tensor, used: Tensor, weight: Tensor) -> None:
        """Take a sample in; x counts where ``used`` is 1, y with its ``weight`` too."""
        self.input.observe(x, used)
        self.output.observe(y, weight * used)

    def settle(self) -> tuple[Tensor, Tensor, Tensor]:
        """Adopt what was observed: ``new z = (old z + offset) ratio``, ``new t = old t ratio_t``."""
        return *self.input.settle(), self.output.settle()[1]

    def reset(self) -> None:
        """Back to z = x, t = y."""
        self.input.reset()
        self.output.reset()
