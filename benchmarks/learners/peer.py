"""What the peers of other libraries have in common behind the contract of learners."""

from __future__ import annotations

import torch
from torch.distributions import Normal

from torch_ekm.residual.kinds import SingleLearner
from torch_ekm.residual.report import UpdateReport
from torch_ekm.typing import Tensor


class Peer(SingleLearner):
    """A model with a law of its own, whose state may lie outside of state dicts.

    A subclass calls :meth:`reset` once it has its parameters.
    """

    def _begin(self) -> None:
        """A model that has seen nothing; torch's generator is seeded here."""
        raise NotImplementedError

    def _law(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean, variance of g and of the noise at x ``(n, in)``."""
        raise NotImplementedError

    def _learn(self, x: Tensor, y: Tensor) -> None:
        """One sample more."""
        raise NotImplementedError

    def reset(self) -> None:
        """A new model."""
        super().reset()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            self._begin()

    def _shaped(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x = self.check_query(x)
        mean, variance, noise = self._law(x.reshape(-1, self.in_features))
        shape = (*x.shape[:-1], self.out_features)
        return mean.reshape(shape), variance.reshape(shape), noise

    def forward(self, x: Tensor) -> Tensor:
        """The posterior mean."""
        return self._shaped(x)[0]

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """The posterior law, plus noise on request."""
        with torch.no_grad():
            mean, variance, noise = self._shaped(x)
            variance = variance + noise if observation else variance
        return Normal(mean, variance.sqrt(), validate_args=False)

    def absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        law = self.predict(x, observation=True)
        self._learn(x, y)
        return UpdateReport.of(((y - law.mean) / law.stddev).square().mean(-1), mask)
