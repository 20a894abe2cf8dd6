"""Kinds of learners: of a state in float64, and of one model."""

from __future__ import annotations

import torch

from ..exceptions import ParameterError
from ..typing import Tensor
from .base import ResidualLearner
from .report import UpdateReport


class DoubleStateLearner(ResidualLearner):
    """A learner whose state is float64 for any dtype of its inputs and outputs.

    Device moves take all along; a change of dtype is one of the interface only: float32 cannot hold the
    inverse of a smooth kernel's matrix.
    """

    def _apply(self, fn, recurse=True):
        def keep_double(tensor):
            moved = fn(tensor)
            if tensor is self._like or not tensor.is_floating_point():
                return moved
            return tensor.to(moved.device)

        return super()._apply(keep_double, recurse)

    @property
    def _kept(self) -> torch.dtype:
        return torch.float64


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
