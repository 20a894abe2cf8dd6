"""What the sensors of a simulated hand make of the truth."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
import torch

from ..kinematics.se3 import exp, log
from ..typing import Array
from .parameters import PlantParameters

_LEAST_ANGLE, _LEAST_LENGTH = np.radians(0.002), 2e-6  # [rad, m] taken for a sensor without noise


class TimedState(NamedTuple):
    """The state at one moment, true or as it is seen, hand frame, SI units."""

    time: float
    """[s]"""
    q: Array
    """``(n_q,)`` [rad]"""
    position: Array
    """``(3,)`` [m]"""
    rotation: Array
    """``(3, 3)``"""


class Sensors:
    """Joint angles, object pose and fingertip forces as a calibrated hand would report them.

    A stand-in for Hall sensors, camera and tactile fingertips after their own processing
    (:mod:`torch_ekm.sensing` does that from raw readings)::

        q^ = q + noise, except on stuck channels, which keep their first reading
        o^ = o(t - latency) + noise,  R^ = exp([noise]x) R(t - latency),  or the last frame if lost
        F^ = quantise(scale play(F) + offset + drift t + noise)     8 bit over ``force_range``

    ``play`` is hysteresis: the reading follows the force only once it has moved by half the width.
    The offset is drawn once for each hardware instance; a fingertip that touches nothing reads
    its offset too, if there is one.
    """

    def __init__(self, parameters: PlantParameters, n_q: int, n_pads: int, joints: tuple[str, ...]) -> None:
        self.n_q, self.n_pads, self._joints = n_q, n_pads, joints
        self.set_parameters(parameters)
        self.forget()

    def set_parameters(self, parameters: PlantParameters) -> None:
        self._p = parameters
        hardware_instance = np.random.default_rng([parameters.hardware_seed, 1])
        self._offset = parameters.force_offset * hardware_instance.uniform(-1.0, 1.0, size=self.n_pads)
        self._scale = parameters.force_scale ** hardware_instance.uniform(-1.0, 1.0, size=self.n_pads)
        self._drift = parameters.force_drift * hardware_instance.uniform(-1.0, 1.0, size=self.n_pads)
        self._stuck = np.array([name in parameters.stuck_joints for name in self._joints], dtype=bool)

    def forget(self) -> None:
        """A new grasp: no old frames, no hysteresis."""
        self._frames: deque[TimedState] = deque()
        self._seen: TimedState | None = None
        self._felt = np.zeros(self.n_pads)
        self._stuck_at: Array | None = None

    def remember(self, frame: TimedState) -> None:
        """Keep a state for as long as the latency asks."""
        self._frames.append(frame)
        while len(self._frames) > 1 and self._frames[1].time <= frame.time - self._p.latency + 1e-9:
            self._frames.popleft()

    def pictured(self, now: TimedState) -> TimedState:
        """What the camera's picture shows that is to be had now."""
        return self._frames[0] if self._p.latency > 0 and self._frames else now

    def frame(self, now: TimedState, generator: np.random.Generator) -> tuple[TimedState, bool]:
        """Joints and pose as the sensors have them, of the time of the picture, and whether the camera saw
        the object this time: else its pose is an old one. Joints of stuck channels do not change."""
        p = self._p
        q = now.q + p.joint_noise * generator.standard_normal(self.n_q)
        if self._stuck_at is None:
            self._stuck_at = q
        q = np.where(self._stuck, self._stuck_at, q)
        noise, turn, luck = generator.standard_normal(3), generator.standard_normal(3), generator.random()
        last, seen = self._seen, luck >= p.frame_loss
        if last is None or seen:  # the first frame of a grasp is waited for
            picture = self.pictured(now)
            shaken = exp(torch.from_numpy(p.rotation_noise * turn)).numpy() @ picture.rotation
            last = TimedState(picture.time, q, picture.position + p.position_noise * noise, shaken)
            self._seen, seen = last, True
        return last._replace(q=q), seen

    def agree(self, one: TimedState, other: TimedState) -> bool:
        """Whether two frames differ by their noise: joints, and pose, each by the mean square of what they
        differ, in standard deviations, up to one of its own above its mean."""
        turned = log(torch.from_numpy(other.rotation @ one.rotation.T)).numpy()
        p = self._p
        angle, length = max(p.rotation_noise, _LEAST_ANGLE), max(p.position_noise, _LEAST_LENGTH)
        pose = np.concatenate([turned / angle, (other.position - one.position) / length])
        joints = (other.q - one.q) / max(p.joint_noise, _LEAST_ANGLE)
        return all(np.mean(z**2) / 2 <= 1 + np.sqrt(2 / len(z)) for z in (pose, joints))

    def forces(self, normal: Array, time: float, generator: np.random.Generator) -> Array:
        """Estimated normal force of each pad ``(n_pads,)`` [N], ``time`` after the grasp [s]."""
        p = self._p
        noise = p.force_noise * generator.standard_normal(self.n_pads)
        self._felt = np.clip(self._felt, normal - p.force_hysteresis / 2, normal + p.force_hysteresis / 2)
        off = self._offset + self._drift * max(time, 0.0)
        reading = np.maximum(0.0, self._scale * self._felt + off + np.where(normal > 0, noise, 0.0))
        if p.force_range > 0:  # an 8-bit converter
            unit = p.force_range / 255
            reading = unit * np.round(np.minimum(reading, p.force_range) / unit)
        return reading
