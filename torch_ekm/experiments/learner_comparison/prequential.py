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

    ``mean``, ``deviation`` (observation noise included) and ``y`` are ``(n, m)``; ``density`` is the log
    density of y under the learner's predictive law, where that is not normal. ``seconds`` are those of
    predictions and updates, without the density.
    """

    mean: Float[Tensor, "n m"]
    deviation: Float[Tensor, "n m"]
    y: Float[Tensor, "n m"]
    seconds: float
    density: Float[Tensor, "n m"] | None = None

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
    means, deviations, densities, seconds = [], [], [], 0.0
    heavy = type(learner).predictive is not ResidualLearner.predictive
    for t in range(len(x)):
        if t in starts:
            learner.new_sequence()
        begin = time.perf_counter()
        law = learner.predict(x[t], observation=True)
        means.append(law.mean.detach())
        deviations.append(law.stddev.detach())
        predicted = time.perf_counter()
        if heavy:
            densities.append(learner.predictive(x[t]).log_prob(y[t]).detach())
        asked = time.perf_counter()
        learner.update(x[t], y[t])
        seconds += predicted - begin + time.perf_counter() - asked
    density = torch.stack(densities) if heavy else None
    return Prequential(torch.stack(means), torch.stack(deviations), y, seconds, density)
