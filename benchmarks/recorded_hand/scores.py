"""What is scored: errors over motions, for each coordinate, with paired intervals over objects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torch_ekm.experiments.learner_comparison.scores import block_bootstrap
from torch_ekm.experiments.reporting.statistics import Estimate
from torch_ekm.typing import Array

from .nominal import Samples

COORDINATES = ("x", "y", "angle")
FIRST = 50
"""Samples of an object that count as its first."""
_CUT = 0.99  # quantile of each coordinate at which errors and motions are cut: an object that drops


class Row(NamedTuple):
    """One way to predict, at one horizon, on some of the samples."""

    name: str
    horizon: int
    """[steps of 0.1 s]"""
    subset: str
    """"all", "first", "first, smooth" or "changed"."""
    ratio: dict[str, Estimate]
    """Of each coordinate: rms error over rms motion, cut; 1: as if nothing moved."""
    rms: float
    """rms error of all coordinates in units of their spread, over that of the motion: mean over objects."""
    median: float
    """The same of the median absolute values, of objects that move in more than half of the samples."""


def subsets(samples: Mapping[str, Samples]) -> dict[str, dict[str, NDArray[np.bool_]]]:
    """Which samples of each object count, by name of the subset."""
    first = {name: np.arange(len(taken.motion)) < FIRST for name, taken in samples.items()}
    return {
        "all": {name: np.ones(len(taken.motion), dtype=bool) for name, taken in samples.items()},
        "first": first,
        "first, smooth": first,
        "changed": {name: taken.changed for name, taken in samples.items()},
    }


def score(
    name: str,
    horizon: int,
    subset: str,
    samples: Mapping[str, Samples],
    predicted: Mapping[str, Array],
    unit: Array,
) -> Row:
    """One row of the table.

    Args:
        samples: of the objects that are reported.
        predicted: of the same objects.
        unit: spread of the motion of the recording set apart ``(3,)``.
    """
    chosen = subsets(samples)[subset]
    motion, error = {}, {}
    for key, taken in samples.items():
        true = taken.smooth if subset == "first, smooth" else taken.motion
        motion[key], error[key] = true[chosen[key]], (true - predicted[key])[chosen[key]]
    blocks = np.repeat(np.arange(len(samples)), [len(part) for part in motion.values()])
    squared = [_cut(np.concatenate(list(parts.values()))) ** 2 for parts in (error, motion)]
    ratio = {
        c: block_bootstrap(squared[0][:, k], squared[1][:, k], blocks) for k, c in enumerate(COORDINATES)
    }
    used = [key for key in samples if len(motion[key])]
    rms = [np.sqrt(np.mean((error[k] / unit) ** 2) / np.mean((motion[k] / unit) ** 2)) for k in used]
    middle = [[np.median(np.abs(parts[k] / unit)) for parts in (error, motion)] for k in used]
    median = [ours / theirs for ours, theirs in middle if theirs > 0]
    return Row(
        name, horizon, subset, ratio, float(np.mean(rms)), float(np.mean(median)) if median else np.nan
    )


def compare_errors(
    samples: Mapping[str, Samples], ours: Mapping[str, Array], theirs: Mapping[str, Array]
) -> dict[str, Estimate]:
    """Of each coordinate: rms error of ours over theirs, cut, 95 % interval over objects, paired."""
    lengths = [len(taken.motion) for taken in samples.values()]
    blocks = np.repeat(np.arange(len(samples)), lengths)
    squared = [
        _cut(np.concatenate([taken.motion - predicted[name] for name, taken in samples.items()])) ** 2
        for predicted in (ours, theirs)
    ]
    return {c: block_bootstrap(squared[0][:, k], squared[1][:, k], blocks) for k, c in enumerate(COORDINATES)}


def _cut(values: Array) -> Array:
    size = np.abs(values)
    return np.minimum(size, np.quantile(size, _CUT, axis=0)) if len(size) else size
