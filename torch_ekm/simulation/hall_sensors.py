"""The Hall channels of a hand, simulated: counts from joint angles."""

from __future__ import annotations

import math

import numpy as np
import torch

from ..description import HandDescription
from ..exceptions import ParameterError, ShapeError
from ..typing import Float, Tensor

_HALF_TURN_DEG = (50.0, 62.0)  # a magnet turns by plus and minus that much before its sensor
_ASYMMETRY_DEG = 6.0  # largest misalignment of a magnet
# Shares of its range by which a channel's curve lies beyond full scale with the joint open and closed, drawn
# from these intervals; negative: it stops short. On 19 robots the open reading is 255 for most proximal
# channels, and 491 to 505 of 510 (medians) for the sums of two; closed, medians are 0 to 22 of 255, and 127
# of 765 for the little finger.
_OPEN_OVERDRIVE, _CLOSED_OVERDRIVE = (-0.03, 0.06), (-0.16, 0.03)


class HallSensors:
    r"""``n = floor(clip(open + (closed - open) u(q) + noise, 0, 255))``, one channel per sensed joint.

    ``u`` is the field of a magnet that turns before a linear sensor,
    ``u = (sin(alpha (2 x - 1) + beta) - sin(beta - alpha)) / (sin(alpha + beta) - sin(beta - alpha))``
    at ``x = (q - lower) / (upper - lower)``, stretched beyond the scale or short of it at
    either end. Curved, monotone, and not a cubic: a cubic calibration has something left to miss.
    Open reads 255 and closed 0 unless the hand's description says otherwise (the iCub's MAIS boards send
    the upper 8 of 12 bits, hence the floor).

    Args:
        hand: its ``hall_sensors`` and joint limits.
        seed: of the channels' own curves (a hand's identity, not the noise of a reading).

    Raises:
        ParameterError: the hand has no Hall sensors.
    """

    def __init__(self, hand: HandDescription, seed: int = 0) -> None:
        if not hand.hall_sensors:
            raise ParameterError(
                "hand.hall_sensors", (), "non-empty: give the transmission file [[hall_sensors]]"
            )
        self.noise = 0.6
        """Standard deviation before the converter [counts]; may be changed at any time."""
        sensors = sorted(hand.hall_sensors, key=lambda sensor: sensor.channel)
        self.joints = tuple(sensor.joint for sensor in sensors)
        self._index = torch.tensor([hand.joint_names.index(joint) for joint in self.joints])
        self._n_q = hand.n_q
        rng, n = np.random.default_rng(seed), len(sensors)
        self._lower = torch.from_numpy(hand.joint_lower.copy())[self._index]
        self._upper = torch.from_numpy(hand.joint_upper.copy())[self._index]
        self._alpha = torch.from_numpy(np.radians(rng.uniform(*_HALF_TURN_DEG, n)))
        self._beta = torch.from_numpy(np.radians(rng.uniform(-_ASYMMETRY_DEG, _ASYMMETRY_DEG, n)))
        self._over = torch.from_numpy(
            np.stack([rng.uniform(*_OPEN_OVERDRIVE, n), rng.uniform(*_CLOSED_OVERDRIVE, n)])
        )
        ends = torch.tensor([[s.open, s.closed] for s in sensors], dtype=torch.float64).T
        self._open, self._closed = ends
        self.stuck: dict[int, float] = {}
        """Readings at which channels are stuck, by place; NaN: at what is read next. May be changed."""

    def field(self, q: Float[Tensor, "*batch n_q"]) -> Float[Tensor, "*batch n_channels"]:
        """Counts before noise, rounding and the ends of the scale.

        Raises:
            ShapeError: the last dimension is not the number of joints.
        """
        if q.shape[-1] != self._n_q:
            raise ShapeError("q", f"(*batch, {self._n_q})", q.shape)
        x = (q[..., self._index].to(torch.float64) - self._lower) / (self._upper - self._lower)
        alpha, beta = self._alpha, self._beta
        start, end = torch.sin(beta - alpha), torch.sin(beta + alpha)
        # held at the ends of the magnet's half turn, so that joints beyond their stops stay monotone
        phase = (alpha * (2 * x - 1) + beta).clamp(-torch.pi / 2, torch.pi / 2)
        u = (torch.sin(phase) - start) / (end - start)
        low, high = self._over
        u = (u - low) / (1 - low - high)
        return self._open + (self._closed - self._open) * u

    def sweep(
        self, n: int, generator: torch.Generator
    ) -> tuple[Float[Tensor, "n n_channels"], Float[Tensor, "n n_channels"]]:
        """Readings and true angles [rad] while each joint goes from its lower to its upper stop.

        What :meth:`HallCalibration.fit` takes.
        """
        share = torch.linspace(0, 1, n, dtype=torch.float64)[:, None]
        angles = self._lower + (self._upper - self._lower) * share
        q = torch.zeros(n, self._n_q, dtype=torch.float64)
        q[:, self._index] = angles
        return self.read(q, generator), angles

    def read(
        self, q: Float[Tensor, "*batch n_q"], generator: torch.Generator
    ) -> Float[Tensor, "*batch n_channels"]:
        """Readings 0..255, whole numbers, of joint angles [rad]."""
        counts = self.field(q)
        noise = torch.randn(counts.shape, generator=generator, dtype=torch.float64)
        counts = (counts + self.noise * noise).clamp(0, 255).floor()
        for k, reading in self.stuck.items():
            if math.isnan(reading):
                self.stuck[k] = float(counts[..., k].flatten()[0])
            counts[..., k] = self.stuck[k]
        return counts
