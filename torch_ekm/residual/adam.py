from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import nn

from ..typing import Bool, Float, Tensor


class Adam(nn.Module):
    """Adam (Kingma & Ba, ICLR 2015) whose moments are buffers, with masks::

        m <- b1 m + (1 - b1) g,   v <- b2 v + (1 - b2) g^2,   p <- p - rate m / (sqrt(v) + 1e-8)

    ``torch.optim`` keeps its moments outside of modules, where ``state_dict``, ``.to()`` and ``deepcopy`` of
    a learner do not reach them, and has one count of steps for all models of a fleet.

    Args:
        parameters: what is to be moved; the same and in the same order in each step.
        betas: b1 and b2.
    """

    def __init__(self, parameters: Iterable[Tensor], betas: tuple[float, float] = (0.9, 0.999)) -> None:
        super().__init__()
        self.betas = betas
        for i, p in enumerate(parameters):
            self.register_buffer(f"first_{i}", torch.zeros_like(p.detach()))
            self.register_buffer(f"second_{i}", torch.zeros_like(p.detach()))

    def correction(self, n):
        """``sqrt(1 - b2^n) / (1 - b1^n)``: factor on the rate of the n-th step, an int or a tensor."""
        b1, b2 = self.betas
        return (1 - b2**n) ** 0.5 / (1 - b1**n)

    def move(
        self,
        i: int,
        p: Float[Tensor, "*shape"],
        gradient: Float[Tensor, "*shape"],
        rate: float | Tensor,
        mask: Bool[Tensor, "*shape"] | None = None,
    ) -> None:
        """One step of the i-th parameter, in place; entries outside ``mask`` and their moments stay."""
        first, second = self.get_buffer(f"first_{i}"), self.get_buffer(f"second_{i}")
        b1, b2 = self.betas
        m, v = first.lerp(gradient, 1 - b1), (b2 * second).addcmul_(gradient, gradient, value=1 - b2)
        moved = p - (rate * m).div_(v.sqrt().add_(1e-8))
        for kept, new in ((first, m), (second, v), (p, moved)):
            kept.copy_(new if mask is None else new.where(mask, kept))

    def reset(self) -> None:
        """Forget the moments of all parameters, as before the first step."""
        for buffer in self.buffers():
            buffer.zero_()
