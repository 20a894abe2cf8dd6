from __future__ import annotations

from typing import NamedTuple

import torch

from .._checks import check_finite, check_shape
from .._noise import NOISE
from ..description import HandDescription
from ..estimation.filters import update
from ..exceptions import JointMismatchError
from ..typing import Float, Tensor
from .hall_calibration import HallCalibration, HallEstimate

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
