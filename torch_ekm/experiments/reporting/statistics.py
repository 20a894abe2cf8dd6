"""From records of trials to figures that can be claimed; the independent unit is an object and a seed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..._extras import require
from ...exceptions import NonFiniteError, ParameterError, ShapeError
from ...typing import Array
from ..records import Record, TrialRecord

#: A figure of a trial; None: this trial has none.
Value = Callable[[TrialRecord], "float | None"]

#: An error is settled when it stays within twice the default tolerance [deg].
BAND_DEG = 0.5
#: Significance level of the learning curves.
ALPHA = 0.05
#: With fewer seeds nothing is called better, and no p-value is given.
LEAST_SEEDS = 10


def steady_state_error(record: TrialRecord) -> float:
    """True error at the end [deg]; a lost object counts with the whole angle that was asked for."""
    return abs(record.angle_deg) if record.lost else record.true_error_deg


def survivor_error(record: TrialRecord) -> float | None:
    """The same, only of objects that were not lost."""
    return None if record.lost else record.true_error_deg


def settle_steps(limit: int) -> Value:
    """Motions after which the measured error stays within the band; ``limit`` if it never does."""

    def value(record: TrialRecord) -> float:
        outside = np.flatnonzero(np.asarray(record.errors_deg) > BAND_DEG)
        settled = int(outside[-1]) + 1 if outside.size else 0
        return float(limit if record.lost or settled >= len(record.errors_deg) else settled)

    return value


def beyond_least(limit: int, step_deg: float) -> Value:
    """Motions to settle beyond the least possible, ``ceil(angle / step)``; below 0 where steps are larger."""
    settled = settle_steps(limit)
    return lambda record: (settled(record) or 0.0) - np.ceil(abs(record.angle_deg) / step_deg - 1e-9)


def mean_of(name: str) -> Value:
    """Mean over the motions of a trial, e.g. of "prediction_ekm_deg"."""

    def value(record: TrialRecord) -> float | None:
        figures = getattr(record, name)
        return float(np.mean(figures)) if figures else None

    return value


def select(records: Iterable[Record], **wanted: Any) -> list[TrialRecord]:
    """Trials of grasped objects with these entries."""
    grasped = (r for r in records if isinstance(r, TrialRecord))
    return [r for r in grasped if all(getattr(r, key) == value for key, value in wanted.items())]


def unit_means(records: Iterable[TrialRecord], value: Value) -> dict[tuple[str, int], float]:
    """Mean of a value for each ``(object, seed)``; trials without the value are left out."""
    found: dict[tuple[str, int], list[float]] = {}
    for record in records:
        x = value(record)
        if x is not None:
            found.setdefault((record.object, record.seed), []).append(x)
    return {unit: float(np.mean(values)) for unit, values in sorted(found.items())}


def paired_means(
    ours: Iterable[TrialRecord],
    theirs: Iterable[TrialRecord],
    ours_value: Value,
    theirs_value: Value | None = None,
) -> tuple[Array, Array]:
    """Unit means of two controllers, for the units that both have."""
    a, b = unit_means(ours, ours_value), unit_means(theirs, theirs_value or ours_value)
    units = [unit for unit in a if unit in b]
    return np.array([a[unit] for unit in units]), np.array([b[unit] for unit in units])


@dataclass(frozen=True)
class Estimate:
    """A figure with its 95 % bootstrap interval."""

    mean: float
    low: float
    high: float
    n: int

    def __format__(self, spec: str) -> str:
        mean, low, high = (format(x, spec or ".3g") for x in (self.mean, self.low, self.high))
        return mean if self.n < 2 else f"{mean} [{low}, {high}]"  # one unit has no interval

    def __str__(self) -> str:
        return format(self)

    def __rmul__(self, factor: float) -> Estimate:
        return Estimate(factor * self.mean, factor * self.low, factor * self.high, self.n)


def bootstrap(
    statistic: Callable[..., Array], *values: Array, seed: int = 0, resamples: int = 4000
) -> Estimate:
    """A statistic with its 95 % percentile bootstrap interval.

    Args:
        statistic: of arrays ``(..., n)``, reduces the last axis.
        values: ``(n,)`` each, one value for each independent unit or block; they are resampled together.

    Raises:
        ShapeError: not arrays of one length, or empty ones.
        NonFiniteError: a value is NaN or infinite.
    """
    samples = _clean(values, least=1)
    n = len(samples[0])
    draws = np.random.default_rng(seed).integers(n, size=(resamples, n))
    low, high = np.nanpercentile(statistic(*(sample[draws] for sample in samples)), [2.5, 97.5])
    return Estimate(float(statistic(*samples)), float(low), float(high), n)


def bootstrap_mean(values: Array, **options: int) -> Estimate:
    """Mean of one value for each unit, see :func:`bootstrap`."""
    return bootstrap(lambda x: x.mean(axis=-1), values, **options)


def bootstrap_ratio(ours: Array, theirs: Array, **options: int) -> Estimate:
    """``mean(ours) / mean(theirs)`` over pairs, see :func:`bootstrap`.

    Raises:
        ParameterError: the mean of ``theirs`` is zero.
    """
    if len(theirs) and np.mean(theirs) == 0:
        raise ParameterError("theirs", 0.0, "a mean that is not zero")

    def ratio(a: Array, b: Array) -> Array:
        below = b.mean(axis=-1)
        return a.mean(axis=-1) / np.where(below == 0, np.nan, below)

    return bootstrap(ratio, ours, theirs, **options)


def estimate(records: Iterable[TrialRecord], value: Value) -> Estimate | None:
    """Mean of a value over units; None if there is none."""
    means = np.array(list(unit_means(records, value).values()))
    return bootstrap_mean(means) if means.size else None


@dataclass(frozen=True)
class Rate:
    """``count / n`` with Wilson's 95 % interval."""

    count: int
    n: int
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.count}/{self.n} [{100 * self.low:.0f}, {100 * self.high:.0f}] %"


def rate(events: Iterable[bool]) -> Rate:
    """How often something happened."""
    outcomes = list(events)
    if not outcomes:
        return Rate(0, 0, 0.0, 1.0)
    count = sum(outcomes)
    interval = require("scipy.stats").binomtest(count, len(outcomes)).proportion_ci(method="wilson")
    return Rate(count, len(outcomes), float(interval.low), float(interval.high))


@dataclass(frozen=True)
class PairedTest:
    """Two-sample (Welch) and paired t-tests of ``ours - theirs``, two-sided."""

    welch_p: float
    paired_p: float
    effect_size: float
    """Cohen's d of the paired differences."""


def paired_test(ours: Array, theirs: Array) -> PairedTest | None:
    """Compare errors of the same units; None with fewer than two.

    The paper's two-sample test is applied to errors of the same trials; the paired test is the
    stronger choice, so both are reported.
    """
    if len(ours) < 2:
        return None
    t = require("scipy.stats").t
    ours, theirs = _clean((ours, theirs))
    difference = ours - theirs
    spread = _spread(difference)
    if spread == 0:  # a t-test of a constant is undefined; say what it means
        p = float(difference[0] == 0)
        return PairedTest(p, p, 0.0)
    n, mean = len(difference), float(difference.mean())
    paired = 2 * t.sf(abs(mean) / (spread / np.sqrt(n)), n - 1)
    error, freedom = _welch(ours, theirs)
    welch = 2 * t.sf(abs(mean) / error, freedom) if error > 0 else float(mean == 0)
    return PairedTest(float(welch), float(paired), mean / spread)


def _spread(values: Array) -> float:
    """Standard deviation; 0 where the values differ by rounding alone."""
    spread = float(values.std(ddof=1))
    return spread if spread > 1e-12 * np.abs(values).max() else 0.0


def _welch(ours: Array, theirs: Array) -> tuple[float, float]:
    """Standard error of the difference of means, and Welch's degrees of freedom::

    s^2 = v_1 / n_1 + v_2 / n_2,  nu = s^4 / (v_1^2 / (n_1^2 (n_1 - 1)) + v_2^2 / (n_2^2 (n_2 - 1)))
    """
    a, b = (_spread(values) ** 2 / len(values) for values in (ours, theirs))
    if a + b == 0:
        return 0.0, float("nan")
    return float(np.sqrt(a + b)), (a + b) ** 2 / (a**2 / (len(ours) - 1) + b**2 / (len(theirs) - 1))


@dataclass(frozen=True)
class LearningCurve:
    """Section IV.D of the paper: ``p(k)`` and ``b(k)`` of the first k trials."""

    p: Array
    """p(k), Welch, one-sided (ours smaller); NaN for k = 1."""
    upper: Array
    """b(k), upper end of the one-sided 95 % interval of ``ours - theirs``; NaN for k = 1."""
    last_negative: int
    """Last Index of Negative Result: the last k (from 1) with p(k) > alpha; 0 if none."""

    @property
    def last_upper(self) -> float:
        """Last Upper Boundary of the Confidence Interval."""
        return float(self.upper[-1])


def learning_curve(ours: Array, theirs: Array) -> LearningCurve:
    """Test the first k trials for every k: from where on is ours significantly better for good?"""
    t = require("scipy.stats").t
    ours, theirs = _clean((ours, theirs))
    p, upper = np.full(len(ours), np.nan), np.full(len(ours), np.nan)
    for k in range(2, len(ours) + 1):
        difference = float(ours[:k].mean() - theirs[:k].mean())
        error, freedom = _welch(ours[:k], theirs[:k])
        if error == 0:  # both are constant
            p[k - 1], upper[k - 1] = float(difference >= 0), difference
            continue
        p[k - 1] = t.cdf(difference / error, freedom)
        upper[k - 1] = difference + t.ppf(1 - ALPHA, freedom) * error
    negative = np.flatnonzero(~(p <= ALPHA))  # k = 1 cannot be tested and counts as negative
    return LearningCurve(p, upper, int(negative[-1]) + 1 if negative.size else 0)


def _clean(samples: Iterable[Array], least: int = 2) -> list[Array]:
    found = [np.asarray(values, dtype=np.float64) for values in samples]
    for values in found:
        if values.ndim != 1 or len(values) < least or values.shape != found[0].shape:
            raise ShapeError("samples", f"(n,) with n >= {least}, all alike", values.shape)
        if not np.isfinite(values).all():
            raise NonFiniteError("samples", np.flatnonzero(~np.isfinite(values))[:3].tolist())
    return found
