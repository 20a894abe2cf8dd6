from __future__ import annotations

from typing import Any

import torch
from torch import nn

from ...typing import Bool, Tensor
from ..running_scale import write
from .posterior import SparsePosterior


class ReplayMemory(nn.Module):
    """The last samples, a part of which is taken at a time, each time others.

    Places depend on the number of samples alone, so two runs of a stream keep the same, and no call waits for
    a GPU.

    Args:
        posterior: whose inputs and outputs are kept, in their own units.
        capacity: number of samples.
    """

    def __init__(self, posterior: SparsePosterior, capacity: int) -> None:
        super().__init__()
        fleet, like, n = posterior.batch_shape, posterior.basis, capacity
        self.capacity = n
        self.x = nn.Buffer(like.new_zeros(*fleet, n, like.shape[-1]))
        self.y = nn.Buffer(like.new_zeros(*fleet, n, posterior.out_features))
        self.weight = nn.Buffer(like.new_zeros(*fleet, n))
        self.absorbed = nn.Buffer(like.new_zeros(n))
        self._n_taken = 0  # on the host, as the places are

    def offer(self, n: int, x: Tensor, y: Tensor, weight: Tensor) -> None:
        """The sample after n, one per model, with its weight in the update, 0 where there was none."""
        place = n % self.capacity
        write(self.x, place, x)
        write(self.y, place, y)
        self.weight.select(-1, place).copy_(weight)
        self.absorbed[place] = 0.0

    def settle(self) -> None:
        """All that is kept is now part of the state that is to predict it."""
        self.absorbed.fill_(1.0)

    def take(self, n_samples: int, n: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """n samples at most, after ``n_samples``, evenly spread over the places, others at the next call.

        Returns:
            ``x (*batch, n, in)``, ``y (*batch, n, out)``, the weights ``(*batch, n)``, 0 for what is not
            yet part of the state, and the ages ``(n,)`` in samples.
        """
        kept = min(n_samples, self.capacity)
        stride = max(kept // n, 1)
        first = self._n_taken % stride
        self._n_taken += 1
        some = slice(first, min(first + stride * n, kept), stride)
        places = torch.arange(some.start, some.stop, stride, device=self.x.device).to(self.weight.dtype)
        age = (n_samples - 1 - places) % self.capacity + 1
        return self.x[..., some, :], self.y[..., some, :], self.weight[..., some] * self.absorbed[some], age

    def forget(self, models: Bool[Tensor, "*batch"]) -> None:
        """What these models saw says nothing about what they are now."""
        self.weight.masked_fill_(models.unsqueeze(-1), 0.0)

    def reset(self) -> None:
        for buffer in self.buffers():
            buffer.zero_()
        self._n_taken = 0

    def get_extra_state(self) -> dict[str, Any]:
        """Calls so far: they decide what is taken."""
        return {"n_taken": self._n_taken}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self._n_taken = int(state["n_taken"])
