"""What a comparison of learners says in numbers, and how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from ...typing import Array
from ..reporting.statistics import Estimate
from .stream import Stream

_BLOCKS = 20
_DECIDED = 0.5
"""Share of the squared error, made by a hundredth of the samples, above which the rms says little."""


@dataclass(frozen=True)
class Score:
    """One learner on one stream, after the warm-up."""

    stream: str
    learner: str
    rms: Estimate
    """rms error over that of the model alone: below 1 the learner helps; 95 % block bootstrap."""
    median: float
    """The same of the median absolute errors: blind to outliers."""
    nll: float
    """Negative log density per sample and output [nats]."""
    coverage: float
    """Share of samples in the central 90 % interval."""
    microseconds: float
    """One prediction with deviation and one update."""
    kilobytes: float
    """Of the state dict."""


@dataclass(frozen=True)
class Comparison:
    """All learners on all streams."""

    streams: tuple[Stream, ...]
    learners: tuple[str, ...]
    scores: dict[tuple[str, str], Score]
    """(stream, learner) -> score."""
    errors: dict[tuple[str, str], Array]
    """(stream, learner) -> squared error of each scored sample, mean over the outputs."""
    calls: dict[str, str] = field(default_factory=dict)
    """learner -> how a user makes it, of d inputs and m outputs, where that is known."""

    def stream(self, name: str) -> Stream:
        """The stream of that name."""
        return next(stream for stream in self.streams if stream.name == name)

    def row(self, stream: str) -> list[Score]:
        """Scores on one stream, in the order of the learners."""
        return [self.scores[stream, name] for name in self.learners]

    def best(self, stream: str, among: Sequence[str] | None = None) -> Score:
        """The smallest rms error on a stream."""
        chosen = [score for score in self.row(stream) if among is None or score.learner in among]
        return min(chosen, key=lambda score: score.rms.mean)

    def ratio(self, stream: str, ours: str, theirs: str, seed: int = 0) -> Estimate:
        """rms error of ``ours`` over that of ``theirs`` on the same samples, 95 % paired block bootstrap."""
        blocks = blocks_of(self.stream(stream))
        return block_bootstrap(self.errors[stream, ours], self.errors[stream, theirs], blocks, seed)

    def ranks(self) -> Array:
        """``(n_streams, n_learners)``, 1 is best; ties share their mean rank."""
        table = np.array([[score.rms.mean for score in self.row(stream.name)] for stream in self.streams])
        mine, others = table[:, :, None], table[:, None, :]
        return (others < mine).sum(-1) + 0.5 * ((others == mine).sum(-1) + 1)

    def critical_difference(self, alpha: float = 0.05) -> float:
        """Mean ranks that differ by less are not distinguishable (Nemenyi; Demsar, JMLR 7, 2006)::

            CD = q sqrt(k (k + 1) / (6 N))

        for k learners on N streams; infinite for one stream.
        """
        k, n = len(self.learners), len(self.streams)
        if n < 2 or k < 2:
            return float("inf")
        return studentized_range(k, alpha) / np.sqrt(2) * np.sqrt(k * (k + 1) / (6 * n))

    def verdicts(self) -> list[str]:
        """For each stream: which learner is best, which cannot be told from it, how far off the default is,
        on how many of how many rows, and whether a few of them decide."""
        sentences = []
        for stream in self.streams:
            best = self.best(stream.name).learner
            ratios = {
                name: self.ratio(stream.name, name, best)
                for name in self.learners
                if name not in (best, "model alone")
            }
            level = [name for name, ratio in ratios.items() if ratio.low <= 1]
            found = f"{self.scores[stream.name, best].rms:.3f}"
            text = f"{stream.name}: {best} is best, {found} of the model alone"
            if level:
                text += f"; this recording does not tell it from {', '.join(level)}"
            behind = sorted((n for n in ratios if n not in level), key=lambda n: ratios[n].mean)
            told = [name for k, name in enumerate(behind) if name == "default" or (k == 0 and not level)]
            text += "".join(f"; {name} has {ratios[name]:.3f} times its error" for name in told)
            text += f". On {stream.used}."
            share = self._rare(stream.name, best)
            if share > _DECIDED:
                text += (
                    f" One row in a hundred makes {100 * share:.0f} % of the squared error: read the median."
                )
            sentences.append(text)
        return sentences

    def _rare(self, stream: str, learner: str) -> float:
        """Share of the squared error that the worst hundredth of the samples makes."""
        errors = np.sort(self.errors[stream, learner])[::-1]
        return float(errors[: max(1, len(errors) // 100)].sum() / max(errors.sum(), np.finfo(float).tiny))


def studentized_range(k: int, alpha: float = 0.05) -> float:
    """The q that the range of k independent standard normals exceeds with probability alpha::

        P(range < q) = k int phi(z) (Phi(z) - Phi(z - q))^(k - 1) dz

    (scipy.stats.studentized_range for infinite degrees of freedom, without scipy).
    """
    z = torch.linspace(-8.0, 8.0, 4001, dtype=torch.float64)
    density, below = torch.exp(-0.5 * z**2) / np.sqrt(2 * np.pi), torch.special.ndtr(z)
    low, high = 0.0, 20.0
    for _ in range(50):
        q = 0.5 * (low + high)
        inside = k * torch.trapezoid(density * (below - torch.special.ndtr(z - q)) ** (k - 1), z)
        low, high = (q, high) if inside < 1 - alpha else (low, q)
    return 0.5 * (low + high)


def blocks_of(stream: Stream) -> NDArray[np.int64]:
    """Which independent block each scored sample belongs to: its segment, or a twentieth of the time."""
    n = len(stream) - stream.warm_up
    if len(stream.segments) >= 5:
        return np.repeat(np.arange(len(stream.segments)), stream.segments)[stream.warm_up :]
    return np.arange(n) * _BLOCKS // n


def block_bootstrap(
    ours: Array, theirs: Array, blocks: NDArray[np.int64], seed: int = 0, resamples: int = 2000
) -> Estimate:
    """``sqrt(sum ours / sum theirs)`` with its 95 % percentile interval over resampled blocks.

    Args:
        ours, theirs: squared errors of the same samples.
        blocks: the block of each sample; samples of a block stay together.
    """
    _, index = np.unique(blocks, return_inverse=True)
    sums = np.stack([np.bincount(index, weights=values) for values in (ours, theirs)])
    draw = np.random.default_rng(seed).integers(sums.shape[1], size=(resamples, sums.shape[1]))
    tiny = np.finfo(float).tiny
    ratios = np.sqrt(sums[0][draw].sum(1) / np.maximum(sums[1][draw].sum(1), tiny))
    low, high = np.percentile(ratios, [2.5, 97.5])
    middle = np.sqrt(ours.sum() / max(theirs.sum(), tiny))
    return Estimate(float(middle), float(low), float(high), sums.shape[1])
