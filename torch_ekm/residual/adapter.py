"""What the adapters of other libraries' learners share."""

from __future__ import annotations

import torch

from ..exceptions import ParameterError
from ..typing import Tensor
from .base import ResidualLearner, UpdateEvent, UpdateReport


class Adapter(ResidualLearner):
    """A learner whose state is another library's object: it travels pickled in the state dict."""

    _count: int

    def _single(self) -> None:
        if self.batch_shape:
            raise ParameterError(
                "batch_shape", tuple(self.batch_shape), "() for this learner; LearnerFleet holds several"
            )

    def _report(self, surprise: Tensor, mask: Tensor | None) -> UpdateReport:
        event = UpdateEvent.ABSORBED if mask is None or bool(mask) else UpdateEvent.REFUSED
        one = torch.ones_like(surprise)
        return UpdateReport(torch.tensor(int(event), device=self.device), 0 * one, surprise, one)
