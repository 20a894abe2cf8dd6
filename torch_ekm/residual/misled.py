"""Whether what was learned misleads: most of the last predictions were much worse than none."""

from __future__ import annotations

import torch
from torch import nn

from ..typing import Bool, Float, Tensor

WORSE = 16.0  # squared errors of so many times the square of y
MISLED_RATE, ALARM = 1 / 16, 0.6


class Misled(nn.Module):
    """``a += ([|y - g|^2 > 16 |y|^2] - a)/16``, misled where ``a > 0.6``: the model alone is better by far.

    Where g is worth nothing an error is four times y in one of ten samples at most; ten of sixteen are
    another system. So a learner of y of size 1 lets go where y is of size 1e-3 from now on: its noise, which
    is of the old size, explains such innovations.

    Args:
        batch_shape: shape of the fleet.
    """

    def __init__(
        self, batch_shape: tuple[int, ...], dtype: torch.dtype, device: torch.device | str | None = None
    ) -> None:
        super().__init__()
        self.level = nn.Buffer(torch.zeros(batch_shape, dtype=dtype, device=device))

    def observe(
        self, error: Float[Tensor, "*batch out"], y: Float[Tensor, "*batch out"], mask: Tensor | None
    ) -> None:
        """Take note of errors before the update."""
        worse = error.square().sum(-1) > WORSE * y.square().sum(-1)
        step = MISLED_RATE * (worse.to(self.level.dtype) - self.level)
        self.level += step if mask is None else step * mask

    def found(self) -> Bool[Tensor, "*batch"] | None:
        """Models that are misled, which begin to count again. None: none."""
        misled = self.level > ALARM
        if not misled.is_cuda and not bool(misled.any()):  # on a GPU looking would mean waiting
            return None
        self.level.masked_fill_(misled, 0.0)
        return misled
