"""The parts of a plant, made from its descriptions and parameters."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ...description import HandDescription, ObjectDescription
from ...exceptions import ParameterError
from ..config import PlantConfig
from ..parameters import PlantParameters
from .servo import Servo
from .transmission import Transmission

_RIGID = 8.0  # [N m/rad] what a looped cable and its servo have where the description says "rigid"


def moment_arms(hand: HandDescription, parameters: PlantParameters) -> NDArray[np.float64]:
    """J_a of the plant ``(n_a, n_q)``.

    Raises:
        ParameterError: there are neither one nor ``n_a`` factors.
    """
    factor = np.asarray(parameters.moment_arm, dtype=np.float64)
    if factor.ndim and factor.shape != (hand.n_a,):
        valid = f"one factor, or {hand.n_a} (one per actuator)"
        raise ParameterError("moment_arm", parameters.moment_arm, valid)
    return hand.actuation_jacobian * np.broadcast_to(factor, (hand.n_a,))[:, None]


def make_transmission(hand: HandDescription, parameters: PlantParameters) -> Transmission:
    """Tendons, springs and joint friction as they are at the start of a grasp."""
    stiffness = np.array([actuator.stiffness for actuator in hand.actuators])
    transmission = Transmission(
        hand,
        moment_arms(hand, parameters),
        parameters.servo_stiffness * np.where(np.isfinite(stiffness), stiffness, _RIGID),
        parameters.spring * hand.spring_stiffness,
        parameters.joint_friction * hand.joint_friction,
        creep=parameters.tendon_creep,
    )
    transmission.lengthen(parameters.tendon_elongation)
    return transmission


def make_servo(hand: HandDescription, config: PlantConfig, parameters: PlantParameters) -> Servo:
    """The position controller of this hardware instance."""
    hardware_instance = np.random.default_rng([parameters.hardware_seed, 0])
    return Servo(
        hand.actuator_lower,
        hand.actuator_upper,
        bias=parameters.actuator_bias * hardware_instance.uniform(-1.0, 1.0, size=hand.n_a),
        fresh_error=parameters.actuator_error,
        dead_zone=parameters.dead_zone,
        threshold=parameters.threshold,
        backlash=parameters.backlash + hand.actuator_backlash,
        relative_to=config.relative_to,
    )


def true_descriptions(
    hand: HandDescription, obj: ObjectDescription, parameters: PlantParameters
) -> tuple[HandDescription, ObjectDescription]:
    """Descriptions that say what the plant really is: the model that knows all but the servos' errors.

    The offsets of the actuators stay nominal: a model of increments needs none.
    """
    transmission = make_transmission(hand, parameters)
    actuators = tuple(
        dataclasses.replace(
            actuator, stiffness=float(stiffness), backlash=actuator.backlash + parameters.backlash
        )
        for actuator, stiffness in zip(hand.actuators, transmission.stiffness, strict=True)
    )
    true_hand = dataclasses.replace(
        hand,
        actuators=actuators,
        actuation_jacobian=transmission.J_a,
        spring_stiffness=transmission.spring_stiffness,
        joint_friction=transmission.friction,
    )
    true_object = dataclasses.replace(
        obj,
        mass=parameters.mass * obj.mass,
        com=obj.com + np.array(parameters.com_shift),
        inertia=parameters.mass * obj.inertia,
        friction=parameters.friction * obj.friction,
        shapes=tuple(shape.scaled(parameters.object_scale) for shape in obj.shapes),
    )
    return true_hand, true_object
