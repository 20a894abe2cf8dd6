from __future__ import annotations

from typing import Any

import torch
from torch import nn

from ..typing import Bool, Float, Tensor


class Recent(nn.Module):
    """The last samples of each model, in their own units, and what they counted for.

    Places depend on the number of samples alone, so two runs of a stream keep the same, and no call waits for
    a GPU.

    Args:
        in_features, out_features: widths of x and y.
        capacity: number of samples.
        options: ``batch_shape``, ``dtype`` and ``device``.
    """

    def __init__(self, in_features: int, out_features: int, capacity: int, **options: Any) -> None:
        super().__init__()
        self.capacity, shape = capacity, (*options.pop("batch_shape"), capacity)
        self.x = nn.Buffer(torch.zeros(*shape, in_features, **options))
        self.y = nn.Buffer(torch.zeros(*shape, out_features, **options))
        # 1 where a model had a sample; and the weight of its update, 0 of one of another system
        self.on = nn.Buffer(torch.zeros(shape, **options))
        self.weight = nn.Buffer(torch.zeros(shape, **options))
        self.n_taken = 0  # on the host, as the places are

    def keep(self, n: int, x: Tensor, y: Tensor, on: Tensor | None) -> None:
        """The sample after n of each model, where ``on``; None: of all."""
        place = n % self.capacity
        self.x.select(-2, place).copy_(x)  # an assignment takes torch three times as long
        self.y.select(-2, place).copy_(y)
        row = self.on.select(-1, place)
        row.fill_(1.0) if on is None else row.copy_(on)

    def weigh(self, n: int, weight: Float[Tensor, "*batch"]) -> None:
        """What the sample after n counted for."""
        place = n % self.capacity
        torch.mul(weight, self.on.select(-1, place), out=self.weight.select(-1, place))

    def last(self, n: int, k: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The last k of n samples in their order: ``x (*batch, k, in)``, y, ``on (*batch, k)``, weights."""
        places = torch.arange(n - k, n, device=self.x.device) % self.capacity
        x, y = (kept.index_select(-2, places) for kept in (self.x, self.y))
        return x, y, self.on.index_select(-1, places), self.weight.index_select(-1, places)

    def take(self, n: int, k: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """k of the last of n samples at most, evenly spread over the places, others at the next call.

        Returns:
            ``x (*batch, k, in)``, ``y (*batch, k, out)``, weights ``(*batch, k)``, ages ``(k,)`` [samples].
        """
        kept = min(n, self.capacity)
        stride = max(kept // k, 1)
        first = self.n_taken % stride
        self.n_taken += 1
        some = slice(first, min(first + stride * k, kept), stride)
        places = torch.arange(some.start, some.stop, stride, device=self.x.device).to(self.weight.dtype)
        age = (n - 1 - places) % self.capacity + 1
        return self.x[..., some, :], self.y[..., some, :], self.weight[..., some], age

    def forget(self, models: Bool[Tensor, "*batch"]) -> None:
        """What these models saw says nothing about what they are."""
        self.weight.masked_fill_(models.unsqueeze(-1), 0.0)

    def reset(self) -> None:
        """No sample was seen."""
        for buffer in self.buffers():
            buffer.zero_()
        self.n_taken = 0

    def get_extra_state(self) -> dict[str, Any]:
        """Calls so far: they decide what is taken."""
        return {"n_taken": self.n_taken}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self.n_taken = int(state["n_taken"])
