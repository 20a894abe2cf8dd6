from __future__ import annotations

from typing import ClassVar

import torch
from torch import nn

from ..residual import ResidualLearner
from ..typing import Float, Int, Tensor

_FREE = -1


class EpisodeMemory(nn.Module):
    """The last ``episodes`` grasps, each with its signature, its first ``samples`` samples and its model.

    Fixed buffers, so that ``state_dict`` holds all of it. The last row is the grasp that goes on now.
    Where there is no room the oldest grasp of the model that has most is given up: what is rare is kept.
    """

    unbounded: ClassVar[tuple[str, ...]] = ("label",)
    """Entries of a state that may be below 0."""

    def __init__(
        self, like: ResidualLearner, models: int, features: int, episodes: int, samples: int
    ) -> None:
        super().__init__()
        self.models, self.episodes, self.samples = models, episodes, samples
        double = {"dtype": torch.float64, "device": like.device}
        count = {"dtype": torch.int64, "device": like.device}
        own = {"dtype": like.dtype, "device": like.device}
        rows = episodes + 1
        self.signature = nn.Buffer(torch.zeros(rows, features, **double))
        self.label = nn.Buffer(torch.full((rows,), _FREE, **count))
        self.evidence = nn.Buffer(torch.zeros(rows, models, **double))
        self.age = nn.Buffer(torch.zeros(rows, **count))
        self.x = nn.Buffer(torch.zeros(rows, samples, like.in_features, **own))
        self.y = nn.Buffer(torch.zeros(rows, samples, like.out_features, **own))
        self.length = nn.Buffer(torch.zeros(rows, **count))

    @property
    def known(self) -> Int[Tensor, " n"]:
        """Rows that hold a past grasp, the oldest first."""
        rows = torch.nonzero(self.label[: self.episodes] != _FREE).flatten()
        return rows[self.age[rows].argsort()]

    def open(self, signature: Float[Tensor, " d"]) -> None:
        """Begin a new grasp, to which the samples that follow belong."""
        self.signature[-1] = signature
        self.length[-1] = 0

    def note(self, x: Tensor, y: Tensor) -> None:
        """A sample of the present grasp; those beyond ``samples`` are not remembered."""
        n = int(self.length[-1])
        if n < self.samples:
            self.x[-1, n], self.y[-1, n] = x, y
            self.length[-1] += 1

    def keep(self, label: int, evidence: Float[Tensor, " models"]) -> int:
        """Remember the present grasp as one of model ``label``; returns its row."""
        free = torch.nonzero(self.label[: self.episodes] == _FREE).flatten()
        row = int(free[0]) if len(free) else self._least_missed()
        self.age[-1] = self.age.max() + 1
        self.label[-1], self.evidence[-1] = label, evidence
        for buffer in (self.signature, self.label, self.evidence, self.age, self.x, self.y, self.length):
            buffer[row] = buffer[-1]
        self.label[-1] = _FREE
        return row

    def replay(self, label: int, learner: ResidualLearner) -> None:
        """Train on all that is remembered of one model, in the order of time."""
        for row in self.known.tolist():
            n = int(self.length[row])
            if self.label[row] == label and n:
                learner.update(self.x[row, :n], self.y[row, :n])

    def reset(self) -> None:
        """Forget all grasps and what was learned from them."""
        for buffer in self.buffers():
            buffer.zero_()
        self.label.fill_(_FREE)

    def _least_missed(self) -> int:
        rows = self.known
        most = torch.bincount(self.label[rows], minlength=self.models).argmax()
        return int(rows[self.label[rows] == most][0])
