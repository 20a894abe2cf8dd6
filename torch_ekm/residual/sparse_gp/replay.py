from __future__ import annotations

import math
from typing import Any

from torch import nn

from ...typing import Bool, Tensor
from ..running_scale import write
from .posterior import SparsePosterior


class ReplayMemory(nn.Module):
    """A random part of all samples so far, or of as many as the learner remembers.

    Each sample is offered a place when it arrives and takes that of another by chance, so that what is
    kept is spread evenly over the past (Vitter, Random sampling with a reservoir, ACM TOMS 11, 1985). With
    a finite ``horizon`` newer samples win: the age of what is kept is then distributed as the weight of
    the past in a learner that forgets at the rate ``1/horizon``.

    Places depend on the sample's number alone, so two runs of a stream keep the same, and no call waits
    for a GPU.

    Args:
        posterior: whose inputs and outputs are kept, in their own units.
        capacity: number of samples.
        horizon: samples that the learner remembers; infinite if it never forgets.
    """

    def __init__(self, posterior: SparsePosterior, capacity: int, horizon: float = math.inf) -> None:
        super().__init__()
        self.capacity, self.horizon = max(math.ceil(min(capacity, horizon)), 1), horizon
        fleet, like = posterior.batch_shape, posterior.basis
        n = self.capacity
        self.x = nn.Buffer(like.new_zeros(*fleet, n, like.shape[-1]))
        self.y = nn.Buffer(like.new_zeros(*fleet, n, posterior.out_features))
        self.weight = nn.Buffer(like.new_zeros(*fleet, n))
        self.absorbed = nn.Buffer(like.new_zeros(n))
        self.number = nn.Buffer(like.new_zeros(n))
        self._n_offered = self._n_taken = 0  # on the host, as the places are

    def offer(self, x: Tensor, y: Tensor, weight: Tensor) -> None:
        """A sample per model with its weight in the update, 0 where there was none."""
        n, place = self._n_offered, self.next_place()
        self.count()
        if place >= 0:
            write(self.x, place, x)
            write(self.y, place, y)
            self.weight.select(-1, place).copy_(weight)
            self.absorbed[place], self.number[place] = 0.0, n

    def next_place(self) -> int:
        """The place of the next sample; -1: there is none for it."""
        n = self._n_offered
        place = n if n < self.capacity else _scattered(n) % math.ceil(min(n + 1, self.horizon))
        return place if place < self.capacity else -1

    def count(self) -> None:
        """The next sample was offered."""
        vars(self)["_n_offered"] += 1  # an assignment to a Module takes ten times as long

    def settle(self) -> None:
        """All that is kept is now part of the state that is to predict it."""
        self.absorbed.fill_(1.0)

    def take(self, n: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """n samples at most, evenly spread over the places, others at the next call.

        Returns:
            ``x (*batch, n, in)``, ``y (*batch, n, out)``, the weights ``(*batch, n)``, 0 for what is not
            yet part of the state, and the ages ``(n,)`` in samples.
        """
        kept = min(self._n_offered, self.capacity)
        stride = max(kept // n, 1)
        first = self._n_taken % stride
        self._n_taken += 1
        some = slice(first, min(first + stride * n, kept), stride)
        weight, age = self.weight[..., some] * self.absorbed[some], self._n_offered - self.number[some]
        return self.x[..., some, :], self.y[..., some, :], weight, age

    def forget(self, models: Bool[Tensor, "*batch"]) -> None:
        """What these models saw says nothing about what they are now."""
        self.weight.masked_fill_(models.unsqueeze(-1), 0.0)

    def reset(self) -> None:
        for buffer in self.buffers():
            buffer.zero_()
        self._n_offered = self._n_taken = 0

    def get_extra_state(self) -> dict[str, Any]:
        """Calls so far: they decide the places."""
        return {"n_offered": self._n_offered, "n_taken": self._n_taken}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self._n_offered, self._n_taken = int(state["n_offered"]), int(state["n_taken"])


def _scattered(n: int) -> int:
    """n as a number that looks random: the finaliser of splitmix64 (Steele et al., OOPSLA 2014)."""
    n = (n + 1) * 0x9E3779B97F4A7C15 % 2**64
    n = (n ^ (n >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
    n = (n ^ (n >> 27)) * 0x94D049BB133111EB % 2**64
    return n ^ (n >> 31)
