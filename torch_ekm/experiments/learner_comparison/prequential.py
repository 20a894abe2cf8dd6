"""Predict, then learn: the honest score of a learner on a stream."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from ...residual.base import ResidualLearner
from ...typing import Float, Tensor

_Z90 = 1.6448536269514722  # half width of a central 90 % interval of the normal law


@dataclass(frozen=True)
class Prequential:
    """Predictions of each sample before it was learned, and what happened.

    ``mean``, ``deviation`` (observation noise included) and ``y`` are ``(n, m)``; ``seconds`` are those of
    predictions and updates.
    """

    mean: Float[Tensor, "n m"]
    deviation: Float[Tensor, "n m"]
    y: Float[Tensor, "n m"]
    seconds: float

    @property
    def error(self) -> Float[Tensor, "n m"]:
        """``y - mean`` ``(n, m)``, in the units of y."""
        return self.y - self.mean

    def nll(self, start: int = 0) -> float:
        """Mean negative log density per output under a normal law [nats]."""
        law = torch.distributions.Normal(self.mean[start:], self.deviation[start:], validate_args=False)
        return float(-law.log_prob(self.y[start:]).mean())

    def coverage(self, start: int = 0) -> Float[Tensor, "*out"]:
        """Share of samples inside the central 90 % interval, per output."""
        return (self.error[start:].abs() <= _Z90 * self.deviation[start:]).to(self.y.dtype).mean(0)


def run_prequential(
    learner: ResidualLearner,
    x: Float[Tensor, "n d"],
    y: Float[Tensor, "n m"],
    segments: Sequence[int] = (),
) -> Prequential:
    """Predict each sample with its deviation, then learn it, in the order of time.

    It calls the learner's ``new_sequence`` between ``segments``, given by their lengths.
    """
    starts = set(itertools.accumulate(segments))
    means, deviations, begin = [], [], time.perf_counter()
    for t in range(len(x)):
        if t in starts:
            learner.new_sequence()
        law = learner.predict(x[t], observation=True)
        means.append(law.mean.detach())
        deviations.append(law.stddev.detach())
        learner.update(x[t], y[t])
    return Prequential(torch.stack(means), torch.stack(deviations), y, time.perf_counter() - begin)
