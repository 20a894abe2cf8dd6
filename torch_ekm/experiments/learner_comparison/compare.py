"""Which learner for which stream: predict, score, update; tables and figures with intervals."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..._extras import require
from ...exceptions import ParameterError
from ..jobs import run_jobs
from ..reporting.statistics import Estimate
from .learners import DEFAULT, OURS
from .prequential import Z90, run_prequential
from .recording import Recording

Array = NDArray[np.float64]
_BLOCKS = 20
_PLAIN = (bool, int, float, str, tuple, type(None))


@dataclass(frozen=True)
class Score:
    """One learner on one recording, after the warm-up."""

    recording: str
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
    """All learners on all recordings."""

    recordings: tuple[Recording, ...]
    learners: tuple[str, ...]
    scores: dict[tuple[str, str], Score]
    """(recording, learner) -> score."""
    errors: dict[tuple[str, str], Array]
    """(recording, learner) -> squared error of each scored sample, mean over the outputs."""

    def row(self, recording: str) -> list[Score]:
        """Scores on one recording, in the order of the learners."""
        return [self.scores[recording, name] for name in self.learners]

    def best(self, recording: str, among: Sequence[str] | None = None) -> Score:
        """The smallest rms error on a recording."""
        chosen = [score for score in self.row(recording) if among is None or score.learner in among]
        return min(chosen, key=lambda score: score.rms.mean)

    def ratio(self, recording: str, ours: str, theirs: str, seed: int = 0) -> Estimate:
        """rms error of ``ours`` over that of ``theirs`` on the same samples, 95 % paired block bootstrap."""
        one = next(r for r in self.recordings if r.name == recording)
        return bootstrap_ratio(
            self.errors[recording, ours], self.errors[recording, theirs], blocks_of(one), seed
        )

    def ranks(self) -> Array:
        """``(n_recordings, n_learners)``, 1 is best; ties share their mean rank."""
        table = [[score.rms.mean for score in self.row(r.name)] for r in self.recordings]
        return require("scipy.stats").rankdata(table, axis=1)

    def critical_difference(self, alpha: float = 0.05) -> float:
        """Mean ranks that differ by less are not distinguishable (Nemenyi; Demsar, JMLR 7, 2006)::

            CD = q sqrt(k (k + 1) / (6 N))

        for k learners on N recordings; infinite for one recording.
        """
        k, n = len(self.learners), len(self.recordings)
        if n < 2 or k < 2:
            return float("inf")
        q = require("scipy.stats").studentized_range.ppf(1 - alpha, k, 1e6) / np.sqrt(2)
        return float(q * np.sqrt(k * (k + 1) / (6 * n)))


def compare(
    recordings: Sequence[Recording],
    learners: Sequence[str] = DEFAULT,
    *,
    folder: Path | None = None,
    processes: int = 1,
    on_done: Callable[[str], None] | None = None,
) -> Comparison:
    """Every learner goes once through every recording: it predicts each sample, is scored, then learns it.

    Args:
        recordings: with different names.
        learners: keys of :data:`~torch_ekm.experiments.learners.LEARNERS`.
        folder: keeps what is finished, so that an interrupted comparison goes on where it stopped.
        processes: how many at once (timings are then those of a busy machine).
        on_done: called with each finished job's name.

    Raises:
        UnknownNameError: no such learner; the message lists them.
        ParameterError: nothing to compare, or two recordings of one name.
    """
    names = [recording.name for recording in recordings]
    if not names or not learners:
        raise ParameterError("recordings, learners", (names, list(learners)), "at least one of each")
    if len(set(names)) < len(names):
        raise ParameterError("recordings", names, "of different names")
    jobs: dict[str, tuple[Any, ...]] = {}
    for learner in learners:
        learner_factory(learner)  # refuse before anything runs
    for recording in recordings:
        for learner in learners:
            digest = _digest(recording, learner)
            jobs[f"{recording.name}_{digest}_{learner.replace(' ', '-')}"] = (recording, learner)
    if folder is None:
        with TemporaryDirectory() as temporary:
            results = run_jobs(run_one, jobs, Path(temporary), processes, on_done)
    else:
        results = run_jobs(run_one, jobs, folder, processes, on_done)
    scores, errors = {}, {}
    for job, result in results.items():
        recording, learner = jobs[job]
        squared, alone = np.array(result["squared"]), _squared(recording.y[recording.warm_up :])
        errors[recording.name, learner] = squared
        scores[recording.name, learner] = Score(
            recording.name,
            learner,
            bootstrap_ratio(squared, alone, blocks_of(recording)),
            *(result[name] for name in ("median", "nll", "coverage", "microseconds", "kilobytes")),
        )
    return Comparison(tuple(recordings), tuple(learners), scores, errors)


def run_one(recording: Recording, learner: str) -> dict[str, Any]:
    """One job: plain figures that JSON can hold."""
    torch.set_num_threads(1)  # small matrices: more threads only wait for each other
    torch.manual_seed(0)
    model = learner_factory(learner)(recording.x.shape[1], recording.y.shape[1])
    run = run_prequential(model, recording.x, recording.y)
    start = recording.warm_up
    error, deviation = run.error[start:], run.deviation[start:]
    return {
        "squared": [float(f"{value:.6g}") for value in _squared(error)],
        "median": run.median_ratio(start),
        "nll": run.nll(start),
        "coverage": float((error.abs() <= Z90 * deviation).double().mean()),
        "microseconds": 1e6 * run.seconds / len(recording),
        "kilobytes": _kilobytes(model),
    }


def blocks_of(recording: Recording) -> NDArray[np.int64]:
    """Which independent block each scored sample belongs to: its segment, or a twentieth of the time."""
    n = len(recording) - recording.warm_up
    if len(recording.segments) >= 5:
        return np.repeat(np.arange(len(recording.segments)), recording.segments)[recording.warm_up :]
    return np.arange(n) * _BLOCKS // n


def bootstrap_ratio(
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


def verdicts(comparison: Comparison) -> list[str]:
    """One sentence for each recording: who wins, by how much, and whether ours loses."""
    others = [name for name in comparison.learners if name not in (*OURS, "model alone")]
    ours = [name for name in comparison.learners if name in OURS]
    sentences = []
    for recording in comparison.recordings:
        best = comparison.best(recording.name)
        text = f"{recording.name}: {best.learner} is best, {best.rms} of the model alone."
        if ours and others:
            mine, rival = (comparison.best(recording.name, names) for names in (ours, others))
            ratio = comparison.ratio(recording.name, mine.learner, rival.learner)
            verb = "wins against" if ratio.high < 1 else "loses to" if ratio.low > 1 else "ties with"
            text += f" Our {mine.learner} {verb} {rival.learner}: ratio {ratio}."
        sentences.append(text)
    return sentences


def _squared(error: torch.Tensor) -> Array:
    return error.square().mean(-1).double().numpy()


def _kilobytes(model: torch.nn.Module) -> float:
    tensors = [value for value in model.state_dict().values() if isinstance(value, torch.Tensor)]
    return sum(value.numel() * value.element_size() for value in tensors) / 1024


def _digest(recording: Recording, learner: str) -> str:
    """Of all that decides a result: the samples, and every figure of the learner as it begins."""
    parts = [recording.x.numpy().tobytes(), recording.y.numpy().tobytes(), str(recording.warm_up).encode()]
    parts.append(str(dataclasses.asdict(recording)["segments"]).encode())
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = learner_factory(learner)(recording.x.shape[1], recording.y.shape[1])
    for name, module in model.named_modules():
        plain = {key: value for key, value in vars(module).items() if isinstance(value, _PLAIN)}
        parts.append(f"{name} {type(module).__name__} {sorted(plain.items())}".encode())
    parts += [value.numpy().tobytes() for value in [*model.parameters(), *model.buffers()]]
    return hashlib.sha1(b"".join(parts)).hexdigest()[:8]
