"""The parts of a plant, made from its descriptions and parameters."""

from __future__ import annotations

import dataclasses

import numpy as np

from ...description import HandDescription, ObjectDescription
from ...exceptions import ParameterError
from ..parameters import PlantParameters
from .transmission import JointShape, Transmission

_RIGID = 100.0  # [N m/rad] at a joint: 0.3 to 0.4 % of a motion from rigid; stiffer settles worse at 1 ms


def true_hand(hand: HandDescription, parameters: PlantParameters) -> HandDescription:
    """What the hand really is, but for the servos' errors and the offsets of the actuators: a model of
    increments needs none. An actuator that is rigid, or stiffer than ``_RIGID`` at its joints, has that.

    Raises:
        ParameterError: the moment arms have neither one nor ``n_a`` factors.
    """
    factor = np.asarray(parameters.moment_arm, dtype=np.float64)
    if factor.ndim and factor.shape != (hand.n_a,):
        valid = f"one factor, or {hand.n_a} (one per actuator)"
        raise ParameterError("moment_arm", parameters.moment_arm, valid)
    limits = _RIGID / np.square(hand.actuation_jacobian).max(axis=1)
    actuators = tuple(
        dataclasses.replace(
            actuator,
            stiffness=parameters.servo_stiffness * min(actuator.stiffness, limit),
            backlash=actuator.backlash + parameters.backlash,
        )
        for actuator, limit in zip(hand.actuators, limits.tolist(), strict=True)
    )
    springs = hand.tendon_springs
    if springs is not None:
        springs = dataclasses.replace(springs, stiffness=parameters.spring * springs.stiffness)
    return dataclasses.replace(
        hand,
        actuators=actuators,
        actuation_jacobian=hand.actuation_jacobian * np.broadcast_to(factor, (hand.n_a,))[:, None],
        spring_stiffness=parameters.spring * hand.spring_stiffness,
        tendon_springs=springs,
        joint_friction=parameters.joint_friction * hand.joint_friction,
    )


def true_object(obj: ObjectDescription, parameters: PlantParameters) -> ObjectDescription:
    """The object with true mass, centre, friction and size, where its description is off."""
    return dataclasses.replace(
        obj,
        mass=parameters.mass * obj.mass,
        com=obj.com + np.array(parameters.com_shift),
        inertia=parameters.mass * obj.inertia,
        friction=parameters.friction * obj.friction,
        shapes=tuple(shape.scaled(parameters.object_scale) for shape in obj.shapes),
    )


def chain(hand: HandDescription, link: str) -> list[int]:
    """Joints that move a link, the nearest first."""
    names = [joint.name for joint in reversed(hand.urdf.joints_to(link))]
    return [hand.joint_names.index(name) for name in names if name in hand.joint_names]


def make_transmission(hand: HandDescription, parameters: PlantParameters) -> Transmission:
    """Tendons, springs and joint friction as they are at the start of a grasp."""
    p = parameters
    coupled = (hand.coupling.reshape(-1, hand.n_q) != 0).any(axis=0)
    draw = np.random.default_rng([p.hardware_seed, 2])
    shape = JointShape(
        np.where(coupled, 0.0, p.arm_variation),
        p.arm_phase * draw.uniform(-1.0, 1.0, size=hand.n_q),
        p.spring_stiffening,
    )
    play = np.zeros(hand.n_q)
    for pad in hand.pads:  # one joint of each finger
        free = [joint for joint in chain(hand, pad.link) if not coupled[joint]]
        play[draw.choice(free or [0])] = p.joint_play if free else 0.0
    transmission = Transmission(true_hand(hand, p), p, shape, play)
    transmission.lengthen(p.tendon_elongation)
    return transmission
