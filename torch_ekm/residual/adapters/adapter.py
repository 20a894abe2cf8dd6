"""What the adapters of other libraries' learners share."""

from __future__ import annotations

import torch

from ...typing import Tensor
from ..base import ResidualLearner, UpdateEvent, UpdateReport


class Adapter(ResidualLearner):
    """A learner whose state is another library's object: it travels pickled in the state dict."""

    _count: int

    def _report(self, surprise: Tensor, mask: Tensor | None) -> UpdateReport:
        event = UpdateEvent.ABSORBED if mask is None or bool(mask) else UpdateEvent.REFUSED
        one = torch.ones_like(surprise)
        return UpdateReport(torch.tensor(int(event), device=self.device), 0 * one, surprise, one)
