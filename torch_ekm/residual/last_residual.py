from __future__ import annotations

from typing import Any, cast

import torch
from torch import nn
from torch.distributions import Normal

from ..exceptions import ParameterError
from ..typing import Float, Tensor
from .base import ResidualLearner
from .report import MomentsWithJacobians, UpdateReport


class LastResidual(ResidualLearner):
    """``g(x) = f([x, y_last])``: neighbours in time know what x does not hold.

    It predicts the *next* sample; call :meth:`new_sequence` between trajectories.

    Args:
        learner: f, of ``in_features + out_features`` inputs; it belongs to this one from now on.
        on_invalid: see ResidualLearner.

    Raises:
        ParameterError: the learner has too few inputs.
    """

    def __init__(self, learner: ResidualLearner, **options: Any) -> None:
        d, m = learner.in_features - learner.out_features, learner.out_features
        if d < 1:
            raise ParameterError("learner", repr(learner), f"of more than {m} inputs: x and the last y")
        shape = {"batch_shape": tuple(learner.batch_shape), "dtype": learner.dtype, "device": learner.device}
        super().__init__(d, m, **{**shape, **options})
        self.learner = learner
        self.last = nn.Buffer(torch.zeros(*self.batch_shape, m, dtype=self.dtype, device=self.device))

    def forward(self, x: Tensor) -> Tensor:
        """Mean of f at x and the last sample, ``f([x, y_last])``."""
        return self.learner(self._with_last(self.check_query(x)))

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """The law of f at x and the last sample."""
        return self.learner.predict(self._with_last(self.check_query(x)), observation=observation)

    def moments(self, x: Tensor, *, observation: bool = False) -> tuple[Tensor, Tensor]:
        """Those of f at x and the last sample."""
        return self.learner.moments(self._with_last(self.check_query(x)), observation=observation)

    def both_moments(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Those of f at x and the last sample."""
        return self.learner.both_moments(self._with_last(self.check_query(x)))

    def linearize(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean of f and its slope by x; that by the last sample is left out."""
        mean, slope = self.learner.linearize(self._with_last(self.check_query(x)))
        return mean, slope[..., : self.in_features]

    def predict_with_jacobians(self, x: Float[Tensor, "*any in"]) -> MomentsWithJacobians:
        """f's mean and variance, and their derivatives by x.

        Raises:
            ParameterError: f does not give its own in closed form.
        """
        if not hasattr(self.learner, "predict_with_jacobians"):
            valid = "one with predict_with_jacobians, such as SparseOnlineGP"
            raise ParameterError("learner", type(self.learner).__name__, valid)
        n, f = self.in_features, cast("Any", self.learner)
        p: MomentsWithJacobians = f.predict_with_jacobians(self._with_last(self.check_query(x)))
        by_x = {"mean_jacobian": p.mean_jacobian[..., :n], "variance_jacobian": p.variance_jacobian[..., :n]}
        return p._replace(**by_x)

    def reset(self) -> None:
        """f back to its prior, no last sample."""
        self.learner.reset()
        self.last.zero_()
        self.n_refused.zero_()

    @torch.no_grad()
    def new_sequence(self) -> None:
        """The next sample does not follow on the last one."""
        self.last.zero_()

    def absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        report = self.learner.step(self._with_last(x), y, mask)
        self.last.copy_(y if mask is None else y.where(mask.unsqueeze(-1), self.last))
        return report

    def _with_last(self, x: Tensor) -> Tensor:
        return torch.cat([x, self.last.to(x.dtype).expand(*x.shape[:-1], self.out_features)], dim=-1)
