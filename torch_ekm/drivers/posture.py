"""Joint angles of a hand that does not measure all of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ..description import HandDescription
from ..sensing.joint_estimator import CHORDS, COUPLING_STD, ENCODER_STD
from ..typing import Float, Tensor

_SENSOR_STD = 0.005  # s_h [rad]
_SPRING_STD = 1.0  # s_0 [rad]: springs decide only what nothing measures


class Posture:
    r"""``min_q |(S q - h) / s_h|^2 + |(J_a q + a_0 - a) / s_a|^2 + |C x / s_c|^2 + x^T K x / s_0^2``,
    ``x = q - q0``, K the springs over their mean.

    Sensors say what single joints do, encoders what sums of them do, couplings what differences do; where
    all is silent, springs decide as in a hand that touches nothing: **not** true of a finger that holds an
    object. With a sensor on every joint q is what they read.

    Args:
        hand: joints, actuators, couplings, springs.
        sensed: joints that have a sensor.
    """

    def __init__(self, hand: HandDescription, sensed: Sequence[str]) -> None:
        self._hand = hand
        n, all_sensed = hand.n_q, tuple(sensed) == hand.joint_names
        S = torch.eye(n, dtype=torch.float64)[[hand.joint_names.index(name) for name in sensed]]
        K = torch.from_numpy(hand.spring_stiffness)
        blocks = [
            (S, _SENSOR_STD),
            (torch.from_numpy(hand.actuation_jacobian), ENCODER_STD),
            (torch.from_numpy(hand.coupling.reshape(-1, n)), COUPLING_STD),
            (torch.diag((K / K.mean()).clamp(min=1e-3).sqrt()), _SPRING_STD),
        ]
        A = torch.cat([block / std for block, std in blocks])
        m = len(S) + hand.n_a
        scale = torch.tensor([1 / _SENSOR_STD] * len(S) + [1 / ENCODER_STD] * hand.n_a, dtype=torch.float64)
        self._gain = torch.linalg.pinv(A)[:, :m] * scale
        self._rest = torch.from_numpy(hand.spring_rest)
        offset = torch.from_numpy(hand.actuator_offset)
        self._middle = torch.cat([S @ self._rest, offset + blocks[1][0] @ self._rest])
        self._all = all_sensed

    def __call__(self, h: Float[Tensor, " n"], a: Float[Tensor, " n_a"]) -> Float[Tensor, " n_q"]:
        """q [rad] from the sensed joints' angles h and the encoders a [rad]."""
        if self._all:
            return h.clone()
        q = self._rest + self._gain @ (torch.cat([h, a]) - self._middle)
        for _ in range(0 if self._hand.lengths.constant else CHORDS):
            bent = torch.from_numpy(self._hand.bent(q.numpy()))
            q = self._rest + self._gain @ (torch.cat([h, a - bent]) - self._middle)
        return q
