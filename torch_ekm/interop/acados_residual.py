"""A learner as the residual model of l4acados, whose interface is kept without importing it."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ..exceptions import ShapeError
from ..residual import ResidualLearner
from ..typing import Array


class AcadosResidual:
    """``g(y)`` at all stages of a horizon at once, ``y = [x; u]``: what l4acados asks of a residual model.

    Learning goes on meanwhile, through ``learner.update``: l4acados asks at every iteration, and nothing is
    compiled again.

    Args:
        learner: any learner, one model.
        columns: of y that it sees, in its order; all of them if None.
    """

    def __init__(self, learner: ResidualLearner, columns: Sequence[int] | None = None) -> None:
        self.learner, self.columns = learner, None if columns is None else list(columns)
        if self.columns is not None and len(self.columns) != learner.in_features:
            raise ShapeError("columns", f"({learner.in_features},)", (len(self.columns),))

    def evaluate(self, y: Array) -> Array:
        """``(N, n_y)`` to the mean ``(N, out)``."""
        return self.value_and_jacobian(y)[0]

    def jacobian(self, y: Array) -> Array:
        """``(N, n_y)`` to ``(out, N, n_y)``; columns that the learner does not see are 0."""
        return self.value_and_jacobian(y)[1]

    def value_and_jacobian(self, y: Array) -> tuple[Array, Array]:
        """Mean ``(N, out)`` and Jacobian ``(out, N, n_y)`` in one pass."""
        stages = torch.as_tensor(y, dtype=torch.float64)
        chosen = list(range(stages.shape[-1])) if self.columns is None else self.columns
        mean, slope = self.learner.linearize(stages[:, chosen])
        whole = torch.zeros(*mean.shape, stages.shape[-1], dtype=torch.float64)
        whole[..., chosen] = slope.double()
        return mean.detach().double().numpy(), whole.transpose(0, 1).contiguous().numpy()
