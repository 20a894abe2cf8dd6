"""Scores of a comparison of learners, and how sure they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from ...typing import Array
from ..reporting.statistics import Estimate, bootstrap
from .stream import Stream

Measure = Literal["rms", "median"]
_BLOCKS = 20
_ABSURD = 100.0  # [nats] of one sample; errors of 14 deviations
_DECIDED = 0.5
"""Share of the squared error, made by a hundredth of the samples, above which the rms says little."""


@dataclass(frozen=True)
class Score:
    """One learner on one stream, after the warm-up."""

    stream: str
    learner: str
    rms: Estimate
    """rms error over that of the model alone: below 1 the learner helps; 95 % block bootstrap."""
    median: Estimate
    """The same of the median absolute errors: insensitive to outliers."""
    nll: float
    """Negative log density per sample and output [nats]."""
    coverage: float
    """Share of samples in the central 90 % interval."""
    microseconds: float
    """One prediction with deviation and one update."""
    kilobytes: float
    """Its state dict takes so much."""
    of_outputs: Mapping[Measure, Sequence[float]] = field(default_factory=dict)
    """rms error, and median of the absolute errors, of each output in the stream's units."""


@dataclass(frozen=True)
class Comparison:
    """Scores and errors of all learners on all streams, and what can be said of them."""

    streams: tuple[Stream, ...]
    learners: tuple[str, ...]
    scores: dict[tuple[str, str], Score]
    """(stream, learner) -> score."""
    errors: dict[tuple[str, str], Array]
    """(stream, learner) -> squared error of each scored sample, mean over the outputs."""

    def measure(self, stream: str) -> Measure:
        """Learners are ranked by rms errors, or by medians where few samples make the rms.

        That is where a hundredth of the samples makes more than half of the squared error of the learner
        with the smallest.
        """
        least = min((self.errors[stream, name] for name in self.learners), key=np.sum)
        return "median" if rare_share(least) > _DECIDED else "rms"

    def error(self, stream: str, learner: str) -> Estimate:
        """Over that of the model alone, by the stream's :meth:`measure`."""
        score = self.scores[stream, learner]
        return score.rms if self.measure(stream) == "rms" else score.median

    def output_errors(self, stream: str, learner: str) -> Array:
        """``(m,)``, error of each output in the units of the file, by the stream's :meth:`measure`."""
        errors = self.scores[stream, learner].of_outputs[self.measure(stream)]
        return np.array(self.stream(stream).unit) * errors

    def stream(self, name: str) -> Stream:
        """The stream of that name, with its samples."""
        return next(stream for stream in self.streams if stream.name == name)

    def row(self, stream: str) -> list[Score]:
        """Scores on one stream, in the order of the learners."""
        return [self.scores[stream, name] for name in self.learners]

    def best(self, stream: str) -> Score:
        """The smallest error on a stream, by its :meth:`measure`."""
        return min(self.row(stream), key=lambda score: self.error(stream, score.learner).mean)

    def ratio(self, stream: str, ours: str, theirs: str) -> Estimate:
        """Error of ``ours`` over that of ``theirs`` on the same samples, by the stream's :meth:`measure`.

        Its interval is that of a paired block bootstrap, 95 %.
        """
        errors = self.errors[stream, ours], self.errors[stream, theirs]
        return block_bootstrap(*errors, blocks_of(self.stream(stream)), measure=self.measure(stream))

    def verdicts(self) -> list[str]:
        """For each stream: which learner is best and whether it helps, which others are not distinguishable
        from it, how far off the default is, on how many of how many rows, whether a few of them decide."""
        return [self._verdict(stream) for stream in self.streams]

    def _verdict(self, stream: Stream) -> str:
        best = self.best(stream.name).learner
        others = [name for name in self.learners if name not in (best, "model alone")]
        ratios = {name: self.ratio(stream.name, name, best) for name in others}
        level = [name for name, ratio in ratios.items() if ratio.low <= 1]
        error, medians = self.error(stream.name, best), self.measure(stream.name) == "median"
        by = "by the median " if medians else ""
        if best == "model alone" or error.high < 1:
            text = f"{stream.name}: {best} is best, {by}{error:.3f} of the model alone"
        else:
            text = f"{stream.name}: no learner is distinguished from the model alone. {best} has the"
            text += f" least error, {by}{error:.3f} of the model's"
        if level:
            text += f"; this recording does not distinguish it from {', '.join(level)}"
        behind = sorted((n for n in ratios if n not in level), key=lambda n: ratios[n].mean)
        named = [name for k, name in enumerate(behind) if name == "default" or (k == 0 and not level)]
        text += "".join(f"; {name} has {ratios[name]:.3f} times its error" for name in named)
        text += f". On {stream.used}."
        if medians:
            share = 100 * rare_share(self.errors[stream.name, best])
            text += f" Medians: one row in a hundred makes {share:.0f} % of the squared error."
            text += " Is it a gap, written as -999?" if share > 99 else ""
        if gives_away(stream):
            text += " The inputs give y: is what was measured among them?"
        text += stream.notes
        if sure := [score.learner for score in self.row(stream.name) if score.nll > _ABSURD]:
            text += f" Errors far beyond the stated variance (NLL): {', '.join(sure)}."
        return text


def rare_share(squared: Array) -> float:
    """Share of the squared errors that the worst hundredth of the samples makes."""
    errors = np.sort(squared)[::-1]
    return float(errors[: max(1, len(errors) // 100)].sum() / max(errors.sum(), np.finfo(float).tiny))


def gives_away(stream: Stream) -> bool:
    """y is a linear function of x, but for 1 %: more than any model leaves over."""
    x = torch.cat([torch.ones_like(stream.x[:, :1]), stream.x], dim=1).double().numpy()
    y = stream.y.double().numpy()
    left = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return bool((left.std(0) < 1e-2 * y.std(0)).any())


def blocks_of(stream: Stream) -> NDArray[np.int64]:
    """Which independent block each scored sample belongs to: its segment, or a twentieth of the time."""
    n = len(stream) - stream.warm_up
    if len(stream.segments) >= 5:
        return np.repeat(np.arange(len(stream.segments)), stream.segments)[stream.warm_up :]
    return np.arange(n) * _BLOCKS // n


def block_bootstrap(
    ours: Array, theirs: Array, blocks: NDArray[np.int64], measure: Measure = "rms"
) -> Estimate:
    """``sqrt(sum ours / sum theirs)``, or of medians, with its 95 % percentile interval over blocks.

    Args:
        ours, theirs: squared errors of the same samples.
        blocks: the block of each sample; samples of a block stay together.
        measure: a mean or a median of the squared errors before the root.
    """
    _, index = np.unique(blocks, return_inverse=True)
    n, options = int(index.max()) + 1, {"resamples": 2000}
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
