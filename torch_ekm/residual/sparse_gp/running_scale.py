"""Units of a stream, estimated on the fly and kept with the learner."""

from __future__ import annotations

import torch
from torch import nn

from ...typing import Float, Tensor


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

    shift: Tensor
    scale: Tensor
    total: Tensor
    mean: Tensor
    spread: Tensor
    shifted: Tensor

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
        self.register_buffer("shift", torch.zeros(shape, **factory))
        self.register_buffer("scale", torch.ones(shape, **factory))
        self.register_buffer("total", torch.zeros(*batch_shape, 1, **factory))
        self.register_buffer("mean", torch.zeros(shape, **factory))
        self.register_buffer("spread", torch.zeros(shape, **factory))  # weighted sum of squares
        columns = torch.tensor(shifted or [False] * features, dtype=dtype, device=device)
        self.register_buffer("shifted", columns)

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
        """Width and which columns are centred."""
        return f"features={self.scale.shape[-1]}, shifted={self.shifted.bool().tolist()}"
