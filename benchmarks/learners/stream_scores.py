"""Scores of a learner on a hand's objects in turn, and on a regression set with a held-out part."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from torch_ekm.experiments.learner_comparison.prequential import Prequential, run_prequential
from torch_ekm.experiments.learner_comparison.recordings import load_regression
from torch_ekm.experiments.learner_comparison.stream import Stream
from torch_ekm.residual import ResidualLearner
from torch_ekm.typing import Tensor


def rms_ratio(run: Prequential, start: int = 0) -> float:
    """rms of the error over rms of y: below 1 the learner helps."""
    return float(run.error[start:].square().mean().sqrt() / run.y[start:].square().mean().sqrt())


def median_ratio(run: Prequential, start: int = 0) -> float:
    """The same of the median absolute values: insensitive to outliers."""
    return float(run.error[start:].abs().median() / run.y[start:].abs().median())


@dataclass(frozen=True)
class ObjectScore:
    """Scores of one object; the second half is what counts after the learner has settled in.

    ``winsorised`` (at 99 %) and ``median`` are ratios like ``rms``.
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
    factory: Callable[[], ResidualLearner], streams: Sequence[Stream], *, kept: bool
) -> list[ObjectScore]:
    """One learner over all objects in order (``kept``), or a fresh one for each."""
    learner, scores = factory(), []
    for stream in streams:
        run = run_prequential(learner if kept else factory(), stream.x, stream.y)
        half = len(stream) // 2
        scores.append(
            ObjectScore(
                stream.name,
                rms_ratio(run),
                rms_ratio(run, half),
                median_ratio(run),
                median_ratio(run, half),
                winsorised_ratio(run),
                winsorised_ratio(run, half),
                run.nll(),
                run.nll() if run.density is None else float(-run.density.mean()),
                tuple(run.coverage().tolist()),
            )
        )
    return scores


def winsorised_ratio(run: Prequential, start: int = 0, level: float = 0.99) -> float:
    """The rms ratio with |error| and |y| cut at this quantile of |y|, per output.

    Residuals of real hands hold a few glitches (an angle that jumps by a quarter turn) which would
    otherwise be all that the rms shows.
    """
    error, y = run.error[start:].abs(), run.y[start:].abs()
    most = torch.quantile(y, level, dim=0)
    return float(error.minimum(most).square().mean().sqrt() / y.minimum(most).square().mean().sqrt())


class Split(NamedTuple):
    """Training samples in the order of arrival, and a held-out test set; all of unit variance."""

    name: str
    x: Tensor
    y: Tensor
    x_test: Tensor
    y_test: Tensor


def load_split(name: str, seed: int, limit: int = 8000) -> Split:
    """A regression set shuffled by ``seed``, cut to ``limit``, a tenth held out."""
    x, y = load_regression(name)
    order = np.random.default_rng(seed).permutation(len(x))[:limit]
    test, train = order[: len(order) // 10], order[len(order) // 10 :]

    def standard(values: np.ndarray, rows: np.ndarray) -> Tensor:
        return torch.from_numpy((values[rows] - values[train].mean(0)) / values[train].std(0))

    return Split(name, standard(x, train), standard(y, train), standard(x, test), standard(y, test))


class SplitScore(NamedTuple):
    """Test error after one pass, in units of the targets' deviation, and the time of one update."""

    rmse: float
    nll: float
    microseconds: float


def score_split(factory: Callable[[int, int], ResidualLearner], split: Split) -> SplitScore:
    """One pass over the training samples, then predictions of the test set."""
    learner = factory(split.x.shape[1], split.y.shape[1])
    begin = time.perf_counter()
    learner.update(split.x, split.y)
    cost = (time.perf_counter() - begin) / len(split.x) * 1e6
    law = learner.predict(split.x_test, observation=True)
    rmse = float((law.mean - split.y_test).square().mean().sqrt())
    return SplitScore(rmse, float(-law.log_prob(split.y_test).mean()), cost)
