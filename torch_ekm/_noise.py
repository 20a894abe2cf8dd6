"""What sensors and models leave open: one table for all that estimates."""

from __future__ import annotations

import math
from dataclasses import dataclass

_DEG = math.pi / 180


@dataclass(frozen=True)
class Noise:
    """Standard deviations, SI units, unless a field says otherwise; shares are of the motion or the force."""

    position: float = 0.3e-3
    """Of the object's place, or of a motion of it [m]: a camera at half a metre."""
    position_at_rest: float = 0.2e-3
    """[m]"""
    rotation: float = 0.2 * _DEG
    """Likewise [rad]."""
    rotation_at_rest: float = 0.15 * _DEG
    """[rad]"""
    joint: float = 0.5 * _DEG
    """Of a joint with a sensor, or of a motion of it [rad]."""
    joint_at_rest: float = 0.3 * _DEG
    """[rad]"""
    unsensed_joint: float = 10 * _DEG
    """Of a joint that only a cable tells of [rad]: pulleys are not as described, and cables stretch."""
    wrong_joint: float = 30 * _DEG
    """Of a joint whose sensor is wrong [rad]."""
    encoder: float = 0.0436
    """By how much an encoder and ``J_a q + a_0`` differ [rad]: at the motors of a loaded hand, behind cables
    that stretch by degrees in a pinch of 5 N; encoders at the joints are good to half a degree."""
    encoder_taut: float = 0.5 * _DEG
    """The same where the stretch of the cable is known by its tension [rad]."""
    still: float = 0.02 * _DEG
    """An encoder that moves by less has not moved, a wanted motion below it is none [rad]."""
    servo: float = 0.1 * _DEG
    """Of a servo's error from motion to motion [rad]."""
    dead_zone: float = 1.0 * _DEG
    """Of a servo's dead zone, before it has moved [rad]."""
    bias: float = 0.3 * _DEG
    """Of a servo's bias, before it has moved [rad]."""
    servo_in_logs: float = 0.15 * _DEG
    """[rad]"""
    dead_zone_in_logs: float = 1.5 * _DEG
    """[rad]"""
    bias_in_logs: float = 0.5 * _DEG
    """[rad]"""
    tendon: float = 0.7 * _DEG
    """Of the joints' answer to a motor, from motion to motion [rad]: fingers share the object's motion."""
    coupling: float = 5e-4
    """Play of a rigid coupling [rad]."""
    arm: float = 0.3
    """Share by which moment arms are not as described."""
    gap: float = 1e-4
    """Of the gap of a pad that presses [m]: what the object's pose and both shapes leave open."""
    gap_of_estimate: float = 0.05e-3
    """[m]"""
    slip: float = 0.05
    """Share of the way of a rolling contact that it slides."""
    followed: float = 0.08
    """Share of a motion that a model leaves whose figures are learned."""
    learned: float = 0.02
    """The same of f + g, on top of what g states."""
    described: float = 0.3
    """The same of a model as described."""
    joint_motion: float = 0.5
    """Of a joint's predicted motion, as a share of the largest of an actuator: a model with tendons of
    another radius predicts joints badly."""
    torque: float = 0.01
    """Unmodelled torque of a joint [N m]."""
    force: float = 0.3
    """Of a measured normal force [N]."""
    force_change: float = 0.25
    """Of a change of it that is predicted and learned [N]."""
    pressing: float = 0.5
    """A pad that measures more is in contact, one that measures less may be dead [N]."""
    pressing_at_least: float = 0.3
    """[N]"""
    any_contact_force: float = 1.5
    """Of a contact force of which nothing is known, per axis [N]."""
    any_normal_force: float = 10.0
    """The same of its normal part, where contacts are known to press [N]."""
    force_drift: float = 0.15
    """By which a contact force leaves its prediction in each motion, per axis [N]."""
    force_share: float = 0.3
    """The same as a share of the predicted change; both add up."""
    friction: float = 0.05
    """Of friction coefficients, relative."""


NOISE = Noise()
"""The values that all parts use."""
