"""Learners that are one model."""

from __future__ import annotations

from ..exceptions import ParameterError
from ..typing import Tensor
from .base import ResidualLearner
from .report import UpdateReport


class SingleLearner(ResidualLearner):
    """A learner that is one model: ``batch_shape`` must be ``()``.

    Its ``absorb`` gets samples only, never a mask.
    """

    def __init__(self, in_features: int, out_features: int, **options) -> None:
        super().__init__(in_features, out_features, **options)
        if self.batch_shape:
            valid = "() for this learner; make one for each model"
            raise ParameterError("batch_shape", tuple(self.batch_shape), valid)

    def step(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        if mask is not None and not bool(mask):
            return UpdateReport.of_nothing(mask, self.dtype)
        return super().step(x, y, None)
