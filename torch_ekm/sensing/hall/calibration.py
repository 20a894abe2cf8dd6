"""Joint angles from Hall readings: a cubic per channel, fitted on a calibration sweep."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import torch

from ..._checks import check_finite
from ...exceptions import ParameterError, ShapeError
from ...typing import Bool, Float, Tensor
from .channel import FULL_SCALE, HallChannel, fit_channel


class HallEstimate(NamedTuple):
    """Joint angles from one set of readings."""

    q: Float[Tensor, "*batch n_channels"]
    """Angles [rad]; of a saturated channel the middle of the range that it cannot resolve."""
    std: Float[Tensor, "*batch n_channels"]
    """Standard deviations [rad]; of a channel that says nothing, that of a uniform spread over its sweep."""
    valid: Bool[Tensor, "*batch n_channels"]
    """False where the channel is saturated or was stuck when calibrated."""
    within: Float[Tensor, "2 *batch n_channels"]
    """Range that a channel leaves open which says no more than that [rad]; of others infinite."""


class HallCalibration:
    r"""``q_k = c_0 + c_1 r + c_2 r^2 + c_3 r^3``, ``r = n_k / 255``, for each channel k.

    The parametric fit of section III.C of the paper, on a sweep in which angles were known. The deviation of
    an estimate is ``sigma^2 = (q'(r) sigma_n)^2 + sigma_m^2``: noise and rounding of the reading through
    the slope of the curve, and what a cubic misses. Both are read off the residuals of the sweep.

    Build one with :meth:`fit`.
    """

    def __init__(self, channels: Sequence[HallChannel]) -> None:
        if not channels:
            raise ParameterError("channels", channels, "at least one channel")
        self.channels = tuple(channels)

        def column(values: Iterable[Any]) -> Tensor:
            return torch.tensor(list(values), dtype=torch.float64)

        self._c = column(c.coefficients for c in channels).T  # (4, n_channels)
        self._low, self._high = column(c.low for c in channels), column(c.high for c in channels)
        self._noise, self._misfit = column(c.noise for c in channels), column(c.misfit for c in channels)
        self._stuck = torch.tensor([c.stuck for c in channels])
        # the angles that a reading of 0, one of 255, and a stuck channel leave open
        at_zero = [c.beyond(upper=not c.rises) for c in channels]
        at_full = [c.beyond(upper=c.rises) for c in channels]
        whole = [(c.angle_min, c.angle_max) for c in channels]
        self._blind = [column(pairs) for pairs in (at_zero, at_full, whole)]

    @property
    def joints(self) -> tuple[str, ...]:
        return tuple(channel.joint for channel in self.channels)

    @classmethod
    def fit(
        cls,
        readings: Float[Tensor, "n n_channels"],
        angles: Float[Tensor, "n n_channels"],
        joints: Sequence[str],
    ) -> HallCalibration:
        """Least squares on the samples of a sweep at which a channel is not saturated.

        A channel that does not answer to its joint's motion is marked as ``stuck``: its estimates are never
        valid.

        Args:
            readings: 0..255.
            angles: of the sensed joints, known from elsewhere [rad].
            joints: name of the joint of each channel.

        Raises:
            ShapeError, NonFiniteError: samples that do not fit together, or NaN.
            ParameterError: readings outside 0..255.
            CalibrationError: a joint was not moved, or too few samples are unsaturated.
            NonMonotoneFitError: a fitted curve turns back within its range.
        """
        readings, angles = readings.to(torch.float64), angles.to(torch.float64)
        if readings.ndim != 2 or readings.shape[1] != len(joints):
            raise ShapeError("readings", f"(n, {len(joints)})", readings.shape)
        if angles.shape != readings.shape:
            raise ShapeError("angles", f"{tuple(readings.shape)} as the readings", angles.shape)
        for name, value in (("readings", readings), ("angles", angles)):
            check_finite(name, value)
        if bool((readings < 0).any() or (readings > FULL_SCALE).any()):
            found = (float(readings.min()), float(readings.max()))
            raise ParameterError("readings", found, "within 0..255")
        return cls([fit_channel(name, readings[:, k], angles[:, k]) for k, name in enumerate(joints)])

    def estimate(self, readings: Float[Tensor, "*batch n_channels"]) -> HallEstimate:
        """Angles, their deviations, and which of them to believe.

        Raises:
            ShapeError: the last dimension is not the number of channels.
            NonFiniteError: a reading is NaN.
        """
        if readings.ndim == 0 or readings.shape[-1] != len(self.channels):
            raise ShapeError("readings", f"(*batch, {len(self.channels)})", readings.shape)
        check_finite("readings", readings)
        n = readings.to(torch.float64)
        held = n.clamp(self._low, self._high)  # noise may carry a sound reading past the range of the sweep
        r, c = held / FULL_SCALE, self._c
        q = c[0] + r * (c[1] + r * (c[2] + r * c[3]))
        slope = (c[1] + r * (2 * c[2] + 3 * r * c[3])) / FULL_SCALE
        std = ((slope * self._noise) ** 2 + self._misfit**2).sqrt()
        blind = (n <= 0, n >= FULL_SCALE, self._stuck.expand_as(n))
        within = torch.stack([torch.full_like(q, -torch.inf), torch.full_like(q, torch.inf)])
        for pinned, ends in zip(blind, self._blind, strict=True):
            q = torch.where(pinned, ends.mean(-1).expand_as(q), q)
            spread = (ends[:, 1] - ends[:, 0]).abs() / 12**0.5
            # never surer than the last reading that is not saturated
            std = torch.where(pinned, torch.maximum(std, (spread**2 + self._misfit**2).sqrt()), std)
            within = torch.stack([torch.where(pinned, ends[:, k], within[k]) for k in (0, 1)])
        return HallEstimate(q, std, ~(blind[0] | blind[1] | blind[2]), within)
