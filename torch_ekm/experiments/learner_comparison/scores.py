"""A learner's score on a stream, and how sure it is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from ...typing import Array
from ..reporting.statistics import Estimate, bootstrap
from .stream import Stream

Measure = Literal["rms", "median"]
_BLOCKS = 20
DECIDED = 0.5
"""Share of the squared error, made by a hundredth of the samples, above which the rms says little."""


@dataclass(frozen=True)
class Score:
    """One learner on one stream, after the warm-up."""

    stream: str
    learner: str
    rms: Estimate
    """rms error over that of the model alone: below 1 the learner helps; 95 % block bootstrap."""
    median: Estimate
    """The same of the median absolute errors: blind to outliers."""
    nll: float
    """Negative log density per sample and output [nats]."""
    coverage: float
    """Share of samples in the central 90 % interval."""
    microseconds: float
    """One prediction with deviation and one update."""
    kilobytes: float
    """Of the state dict."""


def rare_share(squared: Array) -> float:
    """Share of the squared errors that the worst hundredth of the samples makes."""
    errors = np.sort(squared)[::-1]
    return float(errors[: max(1, len(errors) // 100)].sum() / max(errors.sum(), np.finfo(float).tiny))


def gives_away(stream: Stream) -> bool:
    """y is a linear function of x, without noise: more than any model leaves over."""
    x = torch.cat([torch.ones_like(stream.x[:, :1]), stream.x], dim=1).double().numpy()
    y = stream.y.double().numpy()
    left = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return bool((left.std(0) < 1e-6 * y.std(0)).any())


def blocks_of(stream: Stream) -> NDArray[np.int64]:
    """Which independent block each scored sample belongs to: its segment, or a twentieth of the time."""
    n = len(stream) - stream.warm_up
    if len(stream.segments) >= 5:
        return np.repeat(np.arange(len(stream.segments)), stream.segments)[stream.warm_up :]
    return np.arange(n) * _BLOCKS // n


def block_bootstrap(
    ours: Array,
    theirs: Array,
    blocks: NDArray[np.int64],
    seed: int = 0,
    resamples: int = 2000,
    measure: Measure = "rms",
) -> Estimate:
    """``sqrt(sum ours / sum theirs)``, or of medians, with its 95 % percentile interval over blocks.

    Args:
        ours, theirs: squared errors of the same samples.
        blocks: the block of each sample; samples of a block stay together.
        measure: a mean or a median of the squared errors before the root.
    """
    _, index = np.unique(blocks, return_inverse=True)
    n, options = int(index.max()) + 1, {"seed": seed, "resamples": resamples}
    if measure == "rms":
        sums = (np.bincount(index, weights=squared) for squared in (ours, theirs))
        return bootstrap(lambda a, b, axis: _root_ratio(a.sum(axis), b.sum(axis)), *sums, **options)
    errors = np.stack([ours, theirs])
    parts = [errors[:, index == k] for k in range(n)]

    def ratio(drawn: NDArray[np.int64]) -> float:
        return _root_ratio(*np.median(np.hstack([parts[k] for k in drawn]), axis=-1))

    return bootstrap(lambda k, axis: np.apply_along_axis(ratio, axis, k), np.arange(n), **options)


def _root_ratio(ours: Any, theirs: Any) -> Any:
    return np.sqrt(ours / np.maximum(theirs, np.finfo(float).tiny))
