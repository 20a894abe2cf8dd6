"""From records of trials to figures that can be claimed; the independent unit is a seed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..._extras import require
from ...exceptions import ParameterError, ShapeError
from .metrics import Comparison, Estimate, compare_errors

Array = NDArray[np.float64]
Record = dict[str, Any]
Value = Callable[[Record], "float | None"]

#: An error is settled when it stays within twice the default tolerance [deg].
BAND_DEG = 0.5


def steady_state_error(record: Record) -> float:
    """True error at the end [deg]; a lost object counts with the whole angle that was asked for."""
    return abs(record["angle_deg"]) if record["lost"] else record["true_error_deg"]


def survivor_error(record: Record) -> float | None:
    """The same, only of objects that were not lost."""
    return None if record["lost"] else record["true_error_deg"]


def settle_steps(record: Record, band_deg: float = BAND_DEG, limit: int = 40) -> float:
    """Motions after which the measured error stays within the band; ``limit`` if it never does."""
    outside = np.flatnonzero(np.asarray(record["errors_deg"]) > band_deg)
    settled = int(outside[-1]) + 1 if outside.size else 0
    return float(limit if record["lost"] or settled >= len(record["errors_deg"]) else settled)


def mean_prediction(name: str) -> Value:
    """Mean one-step prediction error of a trial, on the trial's own motions.

    Args:
        name: "km" or "ekm", as measured, or "true_..." for the same against the plant's truth.
    """
    kind, _, model = name.rpartition("_")
    key = f"{kind}_prediction_{model}_deg" if kind else f"prediction_{model}_deg"

    def value(record: Record) -> float | None:
        errors = [x for x in record[key] if x is not None]
        return float(np.mean(errors)) if errors else None

    return value


def select(records: Iterable[Record], **wanted: Any) -> list[Record]:
    """Records of grasped objects with these entries."""
    return [r for r in records if r["grasped"] and all(r[key] == value for key, value in wanted.items())]


def unit_means(records: Iterable[Record], value: Value) -> dict[tuple[str, int], float]:
    """Mean of a value for each ``(object, seed)``; trials without the value are left out."""
    found: dict[tuple[str, int], list[float]] = {}
    for record in records:
        x = value(record)
        if x is not None:
            found.setdefault((record["object"], record["seed"]), []).append(x)
    return {unit: float(np.mean(values)) for unit, values in sorted(found.items())}


def paired_means(
    ours: Iterable[Record], theirs: Iterable[Record], ours_value: Value, theirs_value: Value | None = None
) -> tuple[Array, Array]:
    """Unit means of two controllers, for the units that both have."""
    a, b = unit_means(ours, ours_value), unit_means(theirs, theirs_value or ours_value)
    units = [unit for unit in a if unit in b]
    return np.array([a[unit] for unit in units]), np.array([b[unit] for unit in units])


def bootstrap_ratio(
    ours: Array, theirs: Array, confidence: float = 0.95, seed: int = 0, resamples: int = 4000
) -> Estimate:
    """``mean(ours) / mean(theirs)`` with the percentile bootstrap over pairs.

    Raises:
        ShapeError: not two arrays of the same length, or empty ones.
        ParameterError: the mean of ``theirs`` is zero.
    """
    ours, theirs = np.asarray(ours, dtype=float), np.asarray(theirs, dtype=float)
    if ours.ndim != 1 or ours.shape != theirs.shape or not ours.size:
        raise ShapeError("theirs", f"{ours.shape}, that of ours, and not empty", theirs.shape)
    if theirs.mean() == 0:
        raise ParameterError("theirs", 0.0, "a mean that is not zero")
    draws = np.random.default_rng(seed).integers(len(ours), size=(resamples, len(ours)))
    below = theirs[draws].mean(axis=1)
    ratios = ours[draws].mean(axis=1) / np.where(below == 0, np.nan, below)
    tail = 50 * (1 - confidence)
    low, high = np.nanpercentile(ratios, [tail, 100 - tail])
    return Estimate(float(ours.mean() / theirs.mean()), float(low), float(high), len(ours))


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


def compare(ours: Array, theirs: Array) -> Comparison | None:
    """Welch and paired t-tests; None with fewer than two units."""
    return compare_errors(ours, theirs) if len(ours) > 1 else None


def recovery_trials(ekm: Array, km: Array, event: int, share: float = 0.5) -> int | None:
    """Trials after trial ``event`` (from 1) until the E-KM's error is below ``share`` of the KM's.

    1: already in the next trial; None: not within the recording.
    """
    after = np.asarray(ekm)[event:] < share * np.asarray(km)[event:]
    return int(np.argmax(after)) + 1 if after.any() else None
