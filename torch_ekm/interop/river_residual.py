"""Regressors of river behind the contract (extra ``peers``)."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torch.distributions import Normal

from .._extras import require
from ..exceptions import NoStateError
from ..residual.base import SingleLearner
from ..residual.report import UpdateReport
from ..typing import Tensor

_STEP = 1e-3  # of the central differences


class RiverResidual(SingleLearner):
    """Any river regressor, one copy per output; the variance is that of recent innovations, at first 1.

    The mean is 0 before the first sample. River predicts on dictionaries of Python floats: it is not
    differentiable (``linearize`` takes central differences). Its regressors are Python objects, not figures:
    the learner can be copied and pickled, but has no state dict.

    Args:
        model: a river regressor, copied; default ARFRegressor.
        options: see ResidualLearner (``batch_shape`` must be ()).
    """

    def __init__(self, in_features: int, out_features: int, *, model: Any = None, **options: Any) -> None:
        super().__init__(in_features, out_features, **options)
        require("river")
        if model is None:
            model = require("river.forest").ARFRegressor(seed=0)
        self._prototype = model
        self.noise = nn.Buffer(self._like.new_ones(self.out_features))
        self.reset()

    def reset(self) -> None:
        """Fresh copies of the regressor, one for each output."""
        self._models = [self._prototype.clone() for _ in range(self.out_features)]
        self._count = 0
        self.noise.fill_(1.0)
        for count in (self.n_refused, self.largest):
            count.zero_()

    def forward(self, x: Tensor) -> Tensor:
        """Predictions of the regressors; no gradient reaches x."""
        x = self.check_query(x)
        rows = x.detach().reshape(-1, self.in_features).tolist()
        values = [[self._value(model, row) for model in self._models] for row in rows]
        mean = torch.tensor(values, dtype=self.dtype, device=self.device).reshape(*x.shape[:-1], -1)
        return self.bounded(mean) + 0.0 * x[..., :1]

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """The same variance with and without noise: river makes no difference."""
        mean = self(x)
        return Normal(mean, self.noise.sqrt().expand_as(mean), validate_args=False)

    def linearize(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and its central differences with steps of 1e-3 in x."""
        x = self.check_query(x)
        eye = _STEP * torch.eye(self.in_features, dtype=x.dtype, device=x.device)
        up, down = self(x.unsqueeze(-2) + eye), self(x.unsqueeze(-2) - eye)
        return self(x), ((up - down) / (2 * _STEP)).mT

    def _value(self, model: Any, row: list[float]) -> float:
        return float(model.predict_one(dict(enumerate(row))) or 0.0) if self._count else 0.0

    def absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        error = (y - self(x)).square()
        row = dict(enumerate(x.tolist()))
        for model, target in zip(self._models, y.tolist(), strict=True):
            model.learn_one(row, target)
        nis = (error / self.noise).mean(-1)
        self.noise.lerp_(error, max(0.02, 1.0 / (self._count + 2)))
        self._count += 1
        return UpdateReport.of(nis, mask)

    def get_extra_state(self) -> dict[str, Any]:
        """None: reading river's objects from a file would mean to run what the file says.

        Raises:
            NoStateError: always.
        """
        reason = "river's regressors are objects; pickle it if you trust the file"
        raise NoStateError(type(self).__name__, reason)
