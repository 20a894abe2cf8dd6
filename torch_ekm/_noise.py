"""What sensors and models leave open: one table for all that estimates."""

from __future__ import annotations

import math
from dataclasses import dataclass

DEGREE = math.pi / 180


@dataclass(frozen=True)
class Noise:
    """Standard deviations in SI units; shares are of the motion or of the force."""

    position: float = 0.3e-3
    """Of the object's place, or of a motion of it [m]: a camera at half a metre."""
    rotation: float = 0.3 * DEGREE
    """Of the object's orientation, or of a motion of it [rad]."""
    joint: float = 0.5 * DEGREE
    """Of a joint with a sensor, or of a motion of it [rad]: Hall sensors after a calibration."""
    unsensed_joint: float = 10 * DEGREE
    """Of a joint that is measured at its cable alone [rad]: pulleys are not as described, cables stretch."""
    wrong_joint: float = 30 * DEGREE
    """Of a joint whose sensor is wrong [rad]: its range."""
    encoder: float = 0.0436
    """By how much an encoder and ``J_a q + a_0`` differ [rad]: at the motors of a loaded hand, behind cables
    that stretch by degrees in a pinch of 5 N. Where the stretch is known they differ as joints do."""
    still: float = 0.02 * DEGREE
    """An encoder that moves by less has not moved, a wanted motion below it is none [rad]."""
    servo: float = 0.1 * DEGREE
    """Of a servo's error from motion to motion [rad]."""
    dead_zone: float = 1.0 * DEGREE
    """Of a servo's dead zone, before it has moved [rad]."""
    bias: float = 0.3 * DEGREE
    """Of a servo's bias, before it has moved [rad]."""
    tendon: float = 0.7 * DEGREE
    """Of the joints' answer to a motor, from motion to motion [rad]: fingers share the object's motion."""
    coupling: float = 5e-4
    """Play of a rigid coupling [rad]."""
    arm: float = 0.3
    """Share by which moment arms are not as described."""
    gap: float = 1e-4
    """Of the gap of a pad that presses [m]: what the object's pose and both shapes leave open."""
    share: float = 0.08
    """Of a motion, what a model leaves that learns its figures, or f + g on top of what g states. With 0.12 a
    tendon that is replaced is no surprise."""
    described: float = 0.3
    """The same of a model as described, which states nothing."""
    force: float = 0.3
    """Of a measured normal force, or of a change of it that is predicted [N]."""
    pressing: float = 0.5
    """A pad that measures less does not touch, or is dead [N]."""
    any_normal_force: float = 10.0
    """Of a normal force of which nothing is known [N]: as much as a hand presses."""
    force_drift: float = 0.15
    """By which a contact force leaves its prediction in each motion, per axis [N]."""
    force_share: float = 0.3
    """The same as a share of the predicted change; both add up."""
    outlier: float = 4.0
    """So many deviations off, an observation is none of what is estimated."""
    furthest: float = 5.0
    """Bounds of an estimate, in deviations of its prior."""

    @property
    def pose(self) -> tuple[float, ...]:
        """Of an error twist ``(v; w)`` of the object [m, rad]."""
        return (self.position,) * 3 + (self.rotation,) * 3


NOISE = Noise()
"""The values that all parts use."""
