"""Learners whose state is float64 whatever the dtype of their inputs and outputs."""

from __future__ import annotations

from .base import ResidualLearner


class DoubleStateLearner(ResidualLearner):
    """Device moves take all along; a change of dtype is one of the interface only.

    float32 cannot hold the inverse of a smooth kernel's matrix.
    """

    def _apply(self, fn, recurse=True):
        def keep_double(tensor):
            moved = fn(tensor)
            if tensor is self._like or not tensor.is_floating_point():
                return moved
            return tensor.to(moved.device)

        return super()._apply(keep_double, recurse)
