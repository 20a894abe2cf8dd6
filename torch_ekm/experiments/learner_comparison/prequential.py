"""Predict, then learn: the honest score of a learner on a stream."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch

from ...residual.base import ResidualLearner
from ...typing import Float, Tensor
from .datasets import ResidualRecording, Stream

Z90 = 1.6448536269514722  # half width of a central 90 % interval of the normal law


@dataclass(frozen=True)
class Prequential:
    """Predictions of each sample before it was learned, and what happened.

    ``mean``, ``deviation`` (observation noise included) and ``y`` are ``(n, m)``; ``density`` is the log
    density of y under the learner's predictive law, where that is not normal.
    """

    mean: Float[Tensor, "n m"]
    deviation: Float[Tensor, "n m"]
    y: Float[Tensor, "n m"]
    seconds: float
    density: Float[Tensor, "n m"] | None = None

    @property
    def error(self) -> Float[Tensor, "n m"]:
        """y - mean."""
        return self.y - self.mean

    def rms_ratio(self, start: int = 0) -> float:
        """rms of the error over rms of y: below 1 the learner helps."""
        return float(self.error[start:].square().mean().sqrt() / self.y[start:].square().mean().sqrt())

    def median_ratio(self, start: int = 0) -> float:
        """The same of the median absolute values: blind to outliers."""
        return float(self.error[start:].abs().median() / self.y[start:].abs().median())

    def winsorised_ratio(self, start: int = 0, level: float = 0.99) -> float:
        """The rms ratio with |error| and |y| cut at this quantile of |y|, per output.

        Residuals of real hands hold a few glitches (an angle that jumps by a quarter turn) which would
        otherwise be all that the rms tells of.
        """
        error, y = self.error[start:].abs(), self.y[start:].abs()
        most = torch.quantile(y, level, dim=0)
        return float(error.minimum(most).square().mean().sqrt() / y.minimum(most).square().mean().sqrt())

    def predictive_nll(self, start: int = 0) -> float:
        """Mean negative log density of y under :meth:`ResidualLearner.predictive`, per output [nats]."""
        return self.nll(start) if self.density is None else float(-self.density[start:].mean())

    def nll(self, start: int = 0) -> float:
        """Mean negative log density per output under a normal law [nats]."""
        law = torch.distributions.Normal(self.mean[start:], self.deviation[start:], validate_args=False)
        return float(-law.log_prob(self.y[start:]).mean())

    def coverage(self, start: int = 0) -> Float[Tensor, "*out"]:
        """Share of samples inside the central 90 % interval, per output."""
        return (self.error[start:].abs() <= Z90 * self.deviation[start:]).to(self.y.dtype).mean(0)


def run_prequential(
    learner: ResidualLearner, x: Float[Tensor, "n d"], y: Float[Tensor, "n m"]
) -> Prequential:
    """Predict each sample, then learn it."""
    means, deviations, densities, begin = [], [], [], time.perf_counter()
    heavy = type(learner).predictive is not ResidualLearner.predictive
    for t in range(len(x)):
        law = learner.predict(x[t], observation=True)
        means.append(law.mean.detach())
        deviations.append(law.stddev.detach())
        if heavy:
            densities.append(learner.predictive(x[t]).log_prob(y[t]).detach())
        learner.update(x[t], y[t])
    seconds = time.perf_counter() - begin
    density = torch.stack(densities) if heavy else None
    return Prequential(torch.stack(means), torch.stack(deviations), y, seconds, density)


@dataclass(frozen=True)
class ObjectScore:
    """Scores of one object; the second half is what counts after the learner has settled in.

    ``winsorised`` (at 99 %) and ``median`` are ratios like ``rms``; see :class:`Prequential`.
    """

    name: str
    rms: float
    rms_second_half: float
    median: float
    median_second_half: float
    winsorised: float
    winsorised_second_half: float
    nll: float
    predictive_nll: float
    coverage: tuple[float, ...]


def score_objects(
    factory: Callable[[], ResidualLearner], recordings: Sequence[ResidualRecording], *, kept: bool
) -> list[ObjectScore]:
    """One learner over all objects in order (``kept``), or a fresh one for each."""
    learner, scores = factory(), []
    for recording in recordings:
        run = run_prequential(learner if kept else factory(), recording.x, recording.y)
        half = len(recording.x) // 2
        scores.append(
            ObjectScore(
                recording.name,
                run.rms_ratio(),
                run.rms_ratio(half),
                run.median_ratio(),
                run.median_ratio(half),
                run.winsorised_ratio(),
                run.winsorised_ratio(half),
                run.nll(),
                run.predictive_nll(),
                tuple(run.coverage().tolist()),
            )
        )
    return scores


@dataclass(frozen=True)
class StreamScore:
    """Test error after one pass: RMSE and NLL in units of the targets' deviation."""

    learner: str
    stream: str
    rmse: float
    nll: float
    microseconds: float


def compare_learners(
    factories: Mapping[str, Callable[[int, int], ResidualLearner]], streams: Sequence[Stream]
) -> list[StreamScore]:
    """One pass of each learner over each stream, then its predictions of the test set.

    Args:
        factories: name to ``factory(in_features, out_features)``.
        streams: from :func:`~torch_ekm.experiments.learner_comparison.datasets.load_stream`.
    """
    scores = []
    for stream in streams:
        for name, factory in factories.items():
            learner = factory(stream.x.shape[1], stream.y.shape[1])
            begin = time.perf_counter()
            learner.update(stream.x, stream.y)
            cost = (time.perf_counter() - begin) / len(stream.x) * 1e6
            law = learner.predict(stream.x_test, observation=True)
            rmse = float((law.mean - stream.y_test).square().mean().sqrt())
            scores.append(
                StreamScore(name, stream.name, rmse, float(-law.log_prob(stream.y_test).mean()), cost)
            )
    return scores


def recovery_after_change(
    factory: Callable[[], ResidualLearner],
    before: tuple[Tensor, Tensor],
    after: tuple[Tensor, Tensor],
    test: tuple[Tensor, Tensor],
    samples: int = 50,
) -> float:
    """Error after an abrupt change over that of a fresh learner, both after the same new samples.

    Args:
        before: stream (x, y) of the old system.
        after: stream (x, y) of the new one, at least ``samples`` long.
        test: (x, y) of the new system.
    """
    old, fresh = factory(), factory()
    old.update(*before)
    x, y = after[0][:samples], after[1][:samples]
    old.update(x, y)
    fresh.update(x, y)
    rms = [float((learner(test[0]) - test[1]).square().mean().sqrt()) for learner in (old, fresh)]
    return rms[0] / rms[1]


def outlier_cost(
    factory: Callable[[], ResidualLearner],
    stream: Stream,
    *,
    share: float = 0.1,
    size: float = 20.0,
    seed: int = 0,
) -> float:
    """Test RMSE with a share of the targets thrown off by ``size`` deviations, over that without."""
    generator = torch.Generator().manual_seed(seed)
    hit = torch.rand(len(stream.y), 1, generator=generator) < share
    sign = torch.randn(stream.y.shape, generator=generator, dtype=stream.y.dtype).sign()
    clean, dirty = factory(), factory()
    clean.update(stream.x, stream.y)
    dirty.update(stream.x, stream.y + hit * size * sign)
    errors = [(learner(stream.x_test) - stream.y_test).square().mean().sqrt() for learner in (clean, dirty)]
    return float(errors[1] / errors[0])


def copies_of(learner: ResidualLearner) -> Callable[[], ResidualLearner]:
    """A factory from an example: every call gives a deep copy."""
    return lambda: copy.deepcopy(learner)
