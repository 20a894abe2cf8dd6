"""Trials as one frame, and figures that can be claimed; the independent unit is an object and a seed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..._extras import require
from ...typing import Array

if TYPE_CHECKING:
    from ..records import TrialRecord

#: A frame of pandas and one of its columns, which is in an extra: its own annotations are too wide to help.
DataFrame = Any
Series = Any
#: Significance level of the learning curves.
ALPHA = 0.05
#: With fewer seeds nothing is called better, and no p-value is given.
LEAST_SEEDS = 10
_PREDICTIONS = ("prediction_km", "prediction_ekm", "true_prediction_km", "true_prediction_ekm")


def trial_frame(results: Mapping[str, Iterable[TrialRecord]]) -> DataFrame:
    """The trials of all jobs, one row each.

    Columns are the figures of the record and

    ======================  ===============================================================================
    job, grasped            of which job; whether a pinch held the object
    lost, not_reached       as in :class:`~torch_ekm.experiments.records.TrialRecord`
    error_deg               steady-state error: true error at the end; of a lost object the whole angle
    motions                 their number
    prediction_km, ...      mean over the motions of ``prediction_km_deg``, ...; NaN where there is none
    ======================  ===============================================================================

    Args:
        results: job -> its records.
    """
    rows = [
        {"job": job, **vars(one), **_added(one), **one.more}
        for job, records in results.items()
        for one in records
    ]
    return require("pandas").DataFrame(rows).drop(columns="more")


def select(trials: DataFrame, **wanted: Any) -> DataFrame:
    """Trials of grasped objects with these entries."""
    chosen = trials["grasped"].astype(bool)
    for column, value in wanted.items():
        chosen &= trials[column] == value
    return trials[chosen]


def _added(record: TrialRecord) -> dict[str, Any]:
    made = {name: getattr(record, f"{name}_deg") for name in _PREDICTIONS}
    return {
        "grasped": record.grasped,
        "lost": record.lost,
        "not_reached": record.not_reached,
        "error_deg": abs(record.angle_deg) if record.lost else record.true_error_deg,
        "motions": record.steps if record.grasped else math.nan,
        **{name: float(np.mean(errors)) if errors else math.nan for name, errors in made.items()},
    }


def unit_means(trials: DataFrame, column: str) -> Series:
    """Mean of a column for each object and seed; trials without a value are left out."""
    return trials[column].astype(float).groupby([trials["object"], trials["seed"]]).mean().dropna()


def paired_means(ours: DataFrame, theirs: DataFrame, column: str) -> tuple[Array, Array]:
    """Unit means of two groups of trials, for the units that both have."""
    a, b = unit_means(ours, column).align(unit_means(theirs, column), join="inner")
    return a.to_numpy(), b.to_numpy()


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


def bootstrap(statistic: Callable[..., Any], *values: NDArray[Any], resamples: int = 4000) -> Estimate:
    """A statistic with its 95 % percentile interval (``scipy.stats.bootstrap``).

    Args:
        statistic: ``f(*arrays, axis)``, reduces the axis.
        values: ``(n,)`` each, one value for each independent unit or block; they are resampled together.
    """
    found, n = float(statistic(*values, axis=-1)), len(values[0])
    if n < 2:
        return Estimate(found, found, found, n)
    resampled = require("scipy.stats").bootstrap(
        values, statistic, paired=True, vectorized=True, method="percentile", n_resamples=resamples,
        rng=np.random.default_rng(0),
    )  # fmt: skip
    low, high = resampled.confidence_interval
    return Estimate(found, float(low), float(high), n)


def bootstrap_mean(values: Array) -> Estimate:
    """Mean of one value for each unit, see :func:`bootstrap`."""
    return bootstrap(np.mean, values)


def bootstrap_ratio(ours: Array, theirs: Array) -> Estimate:
    """``mean(ours) / mean(theirs)`` over pairs of values of at least 0, see :func:`bootstrap`."""

    def ratio(a: Array, b: Array, axis: int) -> Array:
        return a.mean(axis) / np.maximum(b.mean(axis), np.finfo(float).tiny)

    return bootstrap(ratio, ours, theirs)


def estimate(trials: DataFrame, column: str) -> Estimate | None:
    """Mean of a column over units; None if it has no value."""
    means = unit_means(trials, column).to_numpy()
    return bootstrap_mean(means) if means.size else None


def rate(events: Iterable[bool]) -> str:
    """How often something happened, ``count/n``, with Wilson's 95 % interval (``scipy.stats.binomtest``)."""
    outcomes = list(events)
    interval = require("scipy.stats").binomtest(sum(outcomes), len(outcomes)).proportion_ci(method="wilson")
    return f"{sum(outcomes)}/{len(outcomes)} [{100 * interval.low:.0f}, {100 * interval.high:.0f}] %"


@dataclass(frozen=True)
class LearningCurve:
    """Section IV.D of the paper: ``p(k)`` and ``b(k)`` of the first k trials."""

    p: Array
    """p(k), Welch, one-sided (ours smaller); NaN for k = 1."""
    upper: Array
    """b(k), upper end of the one-sided 95 % interval of ``ours - theirs``; NaN for k = 1."""
    last_negative: int
    """Last Index of Negative Result: the last k with p(k) > alpha. k = 1 cannot be tested and counts
    as negative."""

    @property
    def last_upper(self) -> float:
        """Last Upper Boundary of the Confidence Interval, in the unit of the errors."""
        return float(self.upper[-1])


def learning_curve(ours: Array, theirs: Array) -> LearningCurve:
    """Test the first k trials for every k: from where on is ours significantly better for good?"""
    stats, n = require("scipy.stats"), len(ours)
    p, upper = np.full(n, np.nan), np.full(n, np.nan)
    for k in range(2, n + 1):
        a, b = ours[:k], theirs[:k]
        if np.ptp(a) == np.ptp(b) == 0:  # a t-test of constants is undefined
            p[k - 1], upper[k - 1] = float(a[0] >= b[0]), a[0] - b[0]
            continue
        test = stats.ttest_ind(a, b, equal_var=False, alternative="less")
        p[k - 1], upper[k - 1] = test.pvalue, test.confidence_interval(1 - ALPHA).high
    negative = np.flatnonzero(~(p <= ALPHA))  # k = 1 cannot be tested and counts as negative
    return LearningCurve(p, upper, int(negative[-1]) + 1 if negative.size else 0)
