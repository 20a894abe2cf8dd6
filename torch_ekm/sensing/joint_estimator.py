"""Joint angles from Hall counts and encoders, and the calibration of the counts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch

from .._checks import check_finite, check_last, check_shape
from .._noise import NOISE
from ..description import HandDescription
from ..estimation.filters import update
from ..exceptions import CalibrationError, JointMismatchError, ParameterError, ShapeError
from ..typing import Bool, Float, Tensor

_FULL_SCALE = 255.0
_MIN_TRAVEL = 0.17  # a sweep must move the joint by at least that much [rad], 10 deg
_MIN_SPAN = 8.0  # a channel that spans less over a sweep is stuck [counts]
_MIN_SAMPLES = 12


class HallEstimate(NamedTuple):
    """Joint angles from one set of readings."""

    q: Float[Tensor, "*batch n_channels"]
    """Angles [rad]; of a saturated channel the middle of the range that it cannot resolve."""
    std: Float[Tensor, "*batch n_channels"]
    """Standard deviations [rad]; of an invalid channel that of a uniform spread over its sweep."""
    valid: Bool[Tensor, "*batch n_channels"]
    """False where the channel is saturated or was stuck when calibrated."""
    within: Float[Tensor, "2 *batch n_channels"]
    """Range that a channel leaves open which says no more than that [rad]; of others infinite."""


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

    def angle(self, reading: Any) -> Any:
        """Value of the cubic [rad] at a reading [counts], also outside ``[low, high]``."""
        r, c = reading / _FULL_SCALE, self.coefficients
        return c[0] + r * (c[1] + r * (c[2] + r * c[3]))

    def estimate(self, n: Float[Tensor, "*batch"]) -> tuple[Tensor, ...]:
        """As :class:`HallEstimate`, of this channel's readings; its two bounds one after the other."""
        held = n.clamp(self.low, self.high)  # noise may carry a sound reading past the range of the sweep
        q, slope = self.angle(held), _slope(self.coefficients, held / _FULL_SCALE)
        std = ((slope * self.noise) ** 2 + self.misfit**2).sqrt()
        lower, upper = torch.full_like(q, -torch.inf), torch.full_like(q, torch.inf)
        # the angles that a reading of 0, one of 255, and a stuck channel leave open
        first, last = sorted((self.angle(self.low), self.angle(self.high)))
        ends = (self.angle_min, first), (last, self.angle_max)
        if self.angle(self.high) <= self.angle(self.low):
            ends = ends[::-1]
        blind = n <= 0, n >= _FULL_SCALE, torch.full_like(n, self.stuck, dtype=torch.bool)
        for pinned, (least, most) in zip(blind, (*ends, (self.angle_min, self.angle_max)), strict=True):
            q = torch.where(pinned, (least + most) / 2, q)
            # never surer than the last reading that is not saturated
            uniform = math.sqrt((abs(most - least) / 12**0.5) ** 2 + self.misfit**2)
            std = torch.where(pinned, std.clamp(min=uniform), std)
            lower, upper = torch.where(pinned, least, lower), torch.where(pinned, most, upper)
        return q, std, ~(blind[0] | blind[1] | blind[2]), lower, upper


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
            CalibrationError: a joint was not moved, too few samples are unsaturated, or a fitted curve turns
                back within its range.
        """
        readings, angles = readings.to(torch.float64), angles.to(torch.float64)
        if readings.ndim != 2 or readings.shape[1] != len(joints):
            raise ShapeError("readings", f"(n, {len(joints)})", readings.shape)
        if angles.shape != readings.shape:
            raise ShapeError("angles", f"{tuple(readings.shape)} as the readings", angles.shape)
        for name, value in (("readings", readings), ("angles", angles)):
            check_finite(name, value)
        if bool((readings < 0).any() or (readings > _FULL_SCALE).any()):
            found = (float(readings.min()), float(readings.max()))
            raise ParameterError("readings", found, "within 0..255")
        return cls([_fit(name, readings[:, k], angles[:, k]) for k, name in enumerate(joints)])

    def estimate(self, readings: Float[Tensor, "*batch n_channels"]) -> HallEstimate:
        """Angles, their deviations, and which of them are valid.

        Raises:
            ShapeError: the last dimension is not the number of channels.
            NonFiniteError: a reading is NaN.
        """
        check_last("readings", readings, len(self.channels))
        check_finite("readings", readings)
        channels = zip(self.channels, readings.to(torch.float64).unbind(-1), strict=True)
        columns = zip(*(channel.estimate(n) for channel, n in channels), strict=True)
        q, std, valid, lower, upper = (torch.stack(column, dim=-1) for column in columns)
        return HallEstimate(q, std, valid, torch.stack([lower, upper]))


def _fit(joint: str, readings: Float[Tensor, " n"], angles: Float[Tensor, " n"]) -> HallChannel:
    """Least squares of the cubic on the unsaturated samples; noise and misfit from the residuals."""
    name = f"Hall channel of {joint}"
    start, end = float(angles.min()), float(angles.max())
    if end - start < _MIN_TRAVEL:
        problem = "the joint moved by less than 10 deg in the sweep; sweep its whole range"
        raise CalibrationError(name, problem)
    if float(readings.max() - readings.min()) < _MIN_SPAN:
        return HallChannel(joint, (0.0, 0.0, 0.0, 0.0), 0.0, _FULL_SCALE, start, end, 0.0, 0.0, stuck=True)
    free = (readings > 0) & (readings < _FULL_SCALE)
    if (n := int(free.sum())) < _MIN_SAMPLES:
        raise CalibrationError(name, f"only {n} unsaturated samples, at least {_MIN_SAMPLES} are needed")
    x, y = readings[free], angles[free]
    r = x / _FULL_SCALE
    V = torch.stack([torch.ones_like(r), r, r**2, r**3], dim=-1)
    # the default driver, gelsy, gave other last digits for the same input from call to call
    c = torch.linalg.lstsq(V, y[:, None], driver="gelsd").solution[:, 0]
    low, high = float(x.min()), float(x.max())
    among = torch.linspace(low, high, 512, dtype=torch.float64)
    sign = torch.sign(_slope(c, among / _FULL_SCALE))
    if len(turning := torch.nonzero(sign[1:] != sign[:-1])):
        at = float(among[turning[0, 0]])
        problem = f"the fitted curve turns back at reading {at:.1f}, within {low:.0f}..{high:.0f}"
        remedy = "sweep the joint over its whole range, slowly, without readings taken while it was blocked"
        raise CalibrationError(name, f"{problem}; {remedy}")
    residual = y - V @ c
    noise, misfit = _split(residual, _slope(c, r))
    c0, c1, c2, c3 = (float(value) for value in c)
    return HallChannel(joint, (c0, c1, c2, c3), low, high, start, end, noise, misfit)


def _slope(c: Any, r: Any) -> Any:
    """``(c_1 + 2 c_2 r + 3 c_3 r^2) / 255`` [rad/count]."""
    return (c[1] + r * (2 * c[2] + 3 * r * c[3])) / _FULL_SCALE


def _split(residual: Tensor, slope: Tensor) -> tuple[float, float]:
    """``E r^2 = slope^2 sigma_n^2 + sigma_m^2``: regression of squares, both parts non-negative."""
    square, s2 = residual**2, slope**2
    s2_mean, square_mean = s2.mean(), square.mean()
    variance = ((s2 - s2_mean) ** 2).mean()
    floor = 1.0 / 12  # rounding to whole counts
    noise2 = float(((s2 - s2_mean) * (square - square_mean)).mean() / variance) if variance > 0 else floor
    most = float(square_mean / s2_mean) if s2_mean > 0 else floor
    noise2 = max(min(noise2, most), floor)
    misfit2 = max(float(square_mean) - noise2 * float(s2_mean), 0.0)
    return noise2**0.5, misfit2**0.5


CHORDS = 20  # steps with typical arms where arms change with the posture

ENCODER_STD, ARM_STD, COUPLING_STD = NOISE.encoder, NOISE.arm, NOISE.coupling  # s_a, and a share; s_c


class JointEstimate(NamedTuple):
    """Joint angles of a hand with their covariance."""

    q: Float[Tensor, "*batch n_q"]
    """Estimated joint angles, in the order of ``hand.joint_names`` [rad]."""
    covariance: Float[Tensor, "*batch n_q n_q"]
    """Covariance of their errors [rad^2]."""


class JointEstimator:
    r"""``min_q sum_k ((q_k - h_k) / s_k)^2 + |(J_a q + a_0 - a) / s_a|^2 + |C (q - q_0) / s_c|^2``.

    Hall channels know single joints, encoders sums of them, rigid couplings differences: together they cover
    joints without a channel, or with one that is saturated or stuck. q stays within the range that such a
    channel leaves open, independent of cables. Where every joint of an actuator has a channel that says more,
    its encoder counts for less: its moment arms may be wrong, ``s_a^2 + (0.3 (a - a_0))^2``. The covariance
    has this deviation of every encoder. A weak prior, uniform over each joint's range, keeps q finite.

    Args:
        hand: joints, actuation Jacobian and couplings, which hold from the rest angles q_0 on.
        calibration: of its Hall channels.

    Raises:
        JointMismatchError: the calibration names joints that the hand does not have.
    """

    def __init__(self, hand: HandDescription, calibration: HallCalibration) -> None:
        unknown = [joint for joint in calibration.joints if joint not in hand.joint_names]
        if unknown:
            raise JointMismatchError(hand.name, (), unknown, hand.joint_names)
        self.hand, self.calibration = hand, calibration
        self._joints = [hand.joint_names.index(joint) for joint in calibration.joints]
        self._select = torch.eye(hand.n_q, dtype=torch.float64)[self._joints]
        self._J_a = torch.from_numpy(hand.actuation_jacobian.copy())
        self._offset = torch.from_numpy(hand.actuator_offset)
        C = torch.from_numpy(hand.coupling.copy())
        self._H, self._apart = torch.cat([self._select, self._J_a, C]), C @ torch.from_numpy(hand.spring_rest)
        lower, upper = (torch.from_numpy(x.copy()) for x in (hand.joint_lower, hand.joint_upper))
        # a locked joint has no range: a small one keeps its variance above zero
        self._prior = (lower + upper) / 2, torch.diag((upper - lower).clamp(min=1e-3) ** 2 / 12)

    def __call__(
        self, readings: Float[Tensor, "*batch n_channels"], actuators: Float[Tensor, "*batch n_a"]
    ) -> JointEstimate:
        """Joint angles from Hall readings 0..255 and encoders [rad].

        Raises:
            ShapeError, NonFiniteError: readings or encoders that cannot be right.
        """
        check_shape("actuators", actuators, (*readings.shape[:-1], self.hand.n_a))
        check_finite("actuators", actuators)
        hall = self.calibration.estimate(readings)
        way = actuators.to(torch.float64) - self._offset
        found = self._linear(hall, way)
        for _ in range(0 if self.hand.lengths.constant else CHORDS):
            found = self._linear(hall, way - torch.from_numpy(self.hand.bent(found.q.numpy())))
        return found

    def _linear(self, hall: HallEstimate, way: Tensor) -> JointEstimate:
        """With typical moment arms; way: the encoders less their offsets, and less what the arms bend."""
        unread = 1 - (hall.std < ENCODER_STD).to(way) @ self._select
        blind = unread @ self._J_a.mT.abs() > 0  # a joint of the actuator has no channel that says more
        arms = ENCODER_STD**2 + (ARM_STD * way) ** 2
        trust = torch.where(blind, ENCODER_STD**2, arms)  # all that there is: no pull towards mid-range
        mean, P = self._prior
        H = self._H.expand(*way.shape[:-1], -1, -1)
        apart = self._apart.expand(*way.shape[:-1], -1)
        tie = torch.full_like(apart, COUPLING_STD**2)
        residual = torch.cat([hall.q, way, apart], dim=-1) - self._H @ mean
        noises = (torch.cat([hall.std**2, variance, tie], dim=-1) for variance in (trust, arms))
        (q, _), (_, covariance) = (update(mean, P, residual, H, R) for R in noises)
        q = torch.from_numpy(q)
        q[..., self._joints] = q[..., self._joints].clamp(*hall.within)
        return JointEstimate(q, torch.from_numpy(covariance))
