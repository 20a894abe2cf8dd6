"""What a comparison of learners says in numbers, and how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from ...typing import Array
from ..learners import OURS
from ..reporting.statistics import Estimate
from .stream import Stream

_BLOCKS = 20


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
        """For each stream: the default learner first, who wins, by how much, whether ours loses, and how many
        of how many rows this was on."""
        others = [name for name in self.learners if name not in (*OURS, "model alone")]
        ours = [name for name in self.learners if name in OURS]
        sentences = []
        for stream in self.streams:
            best = self.best(stream.name)
            text = f"{stream.name}: "
            if "default" in self.learners and best.learner != "default":
                text += f"the default learner's rms error is {self.scores[stream.name, 'default'].rms} "
                text += "of that of the model alone; "
            text += f"{best.learner} is best, {best.rms} of the model alone."
            if ours and others:
                mine, rival = (self.best(stream.name, names) for names in (ours, others))
                ratio = self.ratio(stream.name, mine.learner, rival.learner)
                verb = "wins against" if ratio.high < 1 else "loses to" if ratio.low > 1 else "ties with"
                text += f" Our {mine.learner} {verb} {rival.learner}: ratio {ratio}."
            sentences.append(f"{text} On {stream.used}.")
        return sentences


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
