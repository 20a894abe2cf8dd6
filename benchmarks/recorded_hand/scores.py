"""What is scored: errors over motions, for each coordinate, with intervals over objects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from torch_ekm.experiments.learner_comparison.scores import block_bootstrap
from torch_ekm.experiments.reporting.statistics import Estimate
from torch_ekm.typing import Array

from .nominal import Samples

COORDINATES = ("x", "y", "angle")
_CUT = 0.99  # quantile of each coordinate at which errors and motions are cut: an object that drops


class Row(NamedTuple):
    """One way to predict, at one horizon."""

    name: str
    horizon: int
    """[steps of 0.1 s]"""
    ratio: dict[str, Estimate]
    """Of each coordinate: rms error over rms motion, cut; 1: as if nothing moved."""
    rms: float
    """rms error of all coordinates in units of their spread, over that of the motion: mean over objects."""


def score(
    name: str,
    horizon: int,
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
    motion = {key: taken.motion for key, taken in samples.items()}
    error = {key: motion[key] - predicted[key] for key in samples}
    blocks = np.repeat(np.arange(len(samples)), [len(part) for part in motion.values()])
    wrong, moved = (_cut(np.concatenate(list(parts.values()))) ** 2 for parts in (error, motion))
    ratio = {c: block_bootstrap(wrong[:, k], moved[:, k], blocks) for k, c in enumerate(COORDINATES)}
    rms = [
        np.sqrt(np.mean((error[key] / unit) ** 2) / np.mean((motion[key] / unit) ** 2))
        for key in samples
        if len(motion[key])
    ]
    return Row(name, horizon, ratio, float(np.mean(rms)))


def _cut(values: Array) -> Array:
    size = np.abs(values)
    return np.minimum(size, np.quantile(size, _CUT, axis=0)) if len(size) else size
