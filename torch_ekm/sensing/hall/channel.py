"""One Hall channel: its curve, its range, its noise."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ...exceptions import CalibrationError, NonMonotoneFitError
from ...typing import Float, Tensor

FULL_SCALE = 255.0
_MIN_TRAVEL = 0.17  # a sweep must move the joint by at least that much [rad], 10 deg
_MIN_SPAN = 8.0  # a channel that spans less over a sweep is stuck [counts]
_MIN_SAMPLES = 12


@dataclass(frozen=True)
class HallChannel:
    """``q = sum_i c_i (n / 255)^i`` for readings ``n`` within ``[low, high]``."""

    joint: str
    coefficients: tuple[float, float, float, float]
    """c_0..c_3 [rad]."""
    low: float
    """Smallest unsaturated reading of the sweep."""
    high: float
    """Largest unsaturated reading of the sweep."""
    angle_min: float
    """Smallest angle of the sweep [rad]."""
    angle_max: float
    """Largest angle of the sweep [rad]."""
    noise: float
    """sigma_n: noise and rounding of a reading [counts]."""
    misfit: float
    """sigma_m: what the cubic misses [rad]."""
    stuck: bool = False
    """The channel did not answer in the sweep; its estimates are never valid."""

    def angle(self, reading: float) -> float:
        """Value of the cubic [rad] at a reading [counts], also outside ``[low, high]``."""
        r, c = reading / FULL_SCALE, self.coefficients
        return c[0] + r * (c[1] + r * (c[2] + r * c[3]))

    @property
    def unsaturated(self) -> tuple[float, float]:
        """Angles between which the channel resolves angles [rad], the smaller first."""
        ends = sorted((self.angle(self.low), self.angle(self.high)))
        return ends[0], ends[1]

    def beyond(self, upper: bool) -> tuple[float, float]:
        """The angles past the last that is resolved, up to the end of the sweep [rad]."""
        return (self.unsaturated[1], self.angle_max) if upper else (self.angle_min, self.unsaturated[0])

    @property
    def rises(self) -> bool:
        """True where larger readings mean larger angles (a reversed channel)."""
        return self.angle(self.high) > self.angle(self.low)


def fit_channel(joint: str, readings: Float[Tensor, " n"], angles: Float[Tensor, " n"]) -> HallChannel:
    """Least squares of the cubic on the unsaturated samples; noise and misfit from the residuals.

    Raises:
        CalibrationError: the joint was not moved, or too few samples are unsaturated.
        NonMonotoneFitError: the cubic turns back within its range.
    """
    name = f"Hall channel of {joint}"
    start, end = float(angles.min()), float(angles.max())
    if end - start < _MIN_TRAVEL:
        problem = "the joint moved by less than 10 deg in the sweep; sweep its whole range"
        raise CalibrationError(name, problem)
    if float(readings.max() - readings.min()) < _MIN_SPAN:
        return HallChannel(joint, (0.0, 0.0, 0.0, 0.0), 0.0, FULL_SCALE, start, end, 0.0, 0.0, stuck=True)
    free = (readings > 0) & (readings < FULL_SCALE)
    n = int(free.sum())
    if n < _MIN_SAMPLES:
        raise CalibrationError(name, f"only {n} unsaturated samples, at least {_MIN_SAMPLES} are needed")
    x, y = readings[free], angles[free]
    r = x / FULL_SCALE
    V = torch.stack([torch.ones_like(r), r, r**2, r**3], dim=-1)
    # the default driver, gelsy, gave other last digits for the same input from call to call
    c = torch.linalg.lstsq(V, y[:, None], driver="gelsd").solution[:, 0]
    low, high = float(x.min()), float(x.max())
    _check_monotone(name, c, low, high)
    residual = y - V @ c
    slope = (c[1] + r * (2 * c[2] + 3 * r * c[3])) / FULL_SCALE
    noise, misfit = _split(residual, slope)
    c0, c1, c2, c3 = (float(value) for value in c)
    return HallChannel(joint, (c0, c1, c2, c3), low, high, start, end, noise, misfit)


def _check_monotone(name: str, c: Tensor, low: float, high: float) -> None:
    """``q'(r) = c_1 + 2 c_2 r + 3 c_3 r^2`` must not change its sign between the ends."""
    r = torch.linspace(low, high, 512, dtype=torch.float64) / FULL_SCALE
    slope = c[1] + r * (2 * c[2] + 3 * r * c[3])
    turning = torch.nonzero(torch.sign(slope[1:]) != torch.sign(slope[:-1]))
    if len(turning):
        at = float(r[turning[0, 0]]) * FULL_SCALE
        raise NonMonotoneFitError(name, at, f"{low:.0f}..{high:.0f}")


def _split(residual: Tensor, slope: Tensor) -> tuple[float, float]:
    """``E r^2 = slope^2 sigma_n^2 + sigma_m^2``: regression of squares, both parts non-negative."""
    square, s2 = residual**2, slope**2
    s2_mean, square_mean = s2.mean(), square.mean()
    variance = ((s2 - s2_mean) ** 2).mean()
    floor = 1.0 / 12  # rounding to whole counts
    noise2 = float(((s2 - s2_mean) * (square - square_mean)).mean() / variance) if variance > 0 else floor
    noise2 = min(max(noise2, floor), float(square_mean / s2_mean) if s2_mean > 0 else floor)
    noise2 = max(noise2, floor)
    misfit2 = max(float(square_mean) - noise2 * float(s2_mean), 0.0)
    return noise2**0.5, misfit2**0.5
