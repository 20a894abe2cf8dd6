"""Errors of a prediction and of a controller, and what statistics say of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..._extras import require
from ...exceptions import NonFiniteError, ParameterError, ShapeError
from ...typing import Float, Tensor

Array = NDArray[np.float64]


def prediction_error(
    increment: Float[Tensor, " n_s"], predicted: Float[Tensor, " n_s"], focus: Float[Tensor, "n_x 6"]
) -> Float[Tensor, " n_x"]:
    """``e(t) = M_c E_p (ds(t) - predicted(t))``: one-step error of the focused pose.

    The paper prints ``e_ekm`` and ``e_km`` swapped and leaves out ``- x_f(t)`` and ``M_c``; this is
    what its figures show. ``predicted`` must be made *before* training on the sample.
    """
    return focus @ (increment - predicted)[-6:]


@dataclass(frozen=True)
class Estimate:
    """A mean with a bootstrap confidence interval."""

    mean: float
    low: float
    high: float
    n: int

    def __str__(self) -> str:
        return f"{self.mean:.3g} [{self.low:.3g}, {self.high:.3g}]"


def bootstrap_mean(values: Array, confidence: float = 0.95, seed: int = 0, resamples: int = 4000) -> Estimate:
    """Mean with its percentile bootstrap interval (one value for each independent run).

    Raises:
        ShapeError: fewer than one value.
        NonFiniteError: a value is NaN or infinite.
    """
    values = _clean("values", values, least=1)
    if len(values) == 1:
        return Estimate(float(values[0]), float(values[0]), float(values[0]), 1)
    stats = require("scipy.stats")
    result = stats.bootstrap(
        (values,),
        np.mean,
        confidence_level=confidence,
        n_resamples=resamples,
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    low, high = result.confidence_interval
    return Estimate(float(values.mean()), float(low), float(high), len(values))


@dataclass(frozen=True)
class Comparison:
    """Two-sample (Welch) and paired t-tests of ``ours - theirs``."""

    welch_p: float
    paired_p: float
    difference: float
    """Mean of ``ours - theirs``; negative: ours is smaller."""
    low: float
    high: float
    """95 % interval of the paired difference."""
    effect_size: float
    """Cohen's d of the paired differences."""


def compare_errors(ours: Array, theirs: Array, confidence: float = 0.95) -> Comparison:
    """Compare absolute errors of the same trials, two-sided.

    The paper's two-sample test is applied to errors of the same trials; the paired test is the
    stronger choice, so both are reported.
    """
    stats = require("scipy.stats")
    ours, theirs = _clean("ours", ours, least=2), _clean("theirs", theirs, least=2)
    if ours.shape != theirs.shape:
        raise ShapeError("theirs", f"{ours.shape}, that of ours", theirs.shape)
    difference = ours - theirs
    spread = difference.std(ddof=1)
    if spread == 0:  # a t-test of a constant is undefined; say what it means
        same = difference[0] == 0
        p, d = (1.0 if same else 0.0), float(difference[0])
        return Comparison(p, p, d, d, d, 0.0)
    paired = stats.ttest_rel(ours, theirs)
    interval = paired.confidence_interval(confidence)
    welch = stats.ttest_ind(ours, theirs, equal_var=False)
    return Comparison(
        float(welch.pvalue),
        float(paired.pvalue),
        float(difference.mean()),
        float(interval.low),
        float(interval.high),
        float(difference.mean() / spread),
    )


@dataclass(frozen=True)
class LearningCurve:
    """Section IV.D of the paper: ``p(k)`` and ``b(k)`` of the first k trials."""

    p: Array
    """p(k), Welch, one-sided (ours smaller); NaN for k = 1."""
    upper: Array
    """b(k), upper end of the one-sided 95 % interval of ``ours - theirs``; NaN for k = 1."""
    last_negative: int
    """Last Index of Negative Result: the last k (from 1) with p(k) > alpha; 0 if none."""
    last_upper: float
    """Last Upper Boundary of the Confidence Interval."""


def learning_curve(ours: Array, theirs: Array, alpha: float = 0.05) -> LearningCurve:
    """Test the first k trials for every k: from where on is ours significantly better for good?"""
    stats = require("scipy.stats")
    ours, theirs = _clean("ours", ours, least=2), _clean("theirs", theirs, least=2)
    if ours.shape != theirs.shape:
        raise ShapeError("theirs", f"{ours.shape}, that of ours", theirs.shape)
    p, upper = np.full(len(ours), np.nan), np.full(len(ours), np.nan)
    for k in range(2, len(ours) + 1):
        if np.ptp(ours[:k]) + np.ptp(theirs[:k]) == 0:
            p[k - 1] = float(ours[0] >= theirs[0])
            upper[k - 1] = ours[0] - theirs[0]
            continue
        test = stats.ttest_ind(ours[:k], theirs[:k], equal_var=False, alternative="less")
        p[k - 1] = test.pvalue
        upper[k - 1] = test.confidence_interval(1 - alpha).high
    negative = np.flatnonzero(~(p <= alpha))  # k = 1 cannot be tested and counts as negative
    return LearningCurve(p, upper, int(negative[-1]) + 1 if negative.size else 0, float(upper[-1]))


def _clean(name: str, values: Array, least: int) -> Array:
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 1 or len(values) < least:
        raise ShapeError(name, f"(n,) with n >= {least}", values.shape)
    if not np.isfinite(values).all():
        raise NonFiniteError(name, np.flatnonzero(~np.isfinite(values))[:3].tolist())
    return values


def root_mean_square(values: Array) -> float:
    """``sqrt(mean x^2)``.

    Raises:
        ParameterError: there is nothing to average.
    """
    values = np.asarray(values, dtype=np.float64)
    if values.size == 0:
        raise ParameterError("values", "an empty list", "at least one value")
    return float(np.sqrt(np.mean(values**2)))
