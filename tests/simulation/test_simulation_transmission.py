"""Tendons, couplings, springs and friction, without a physics engine."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from torch_ekm.description import load_hand
from torch_ekm.simulation.mechanism.departures import CableLosses, JointShape
from torch_ekm.simulation.mechanism.transmission import Transmission, coupled_posture


def make(hand=None, stiffness=4.0, friction=0.0, creep=0.0, **changes):
    hand = load_hand("icub_right") if hand is None else hand
    actuators = tuple(dataclasses.replace(actuator, stiffness=stiffness) for actuator in hand.actuators)
    friction = np.full(hand.n_q, friction)
    real = dataclasses.replace(hand, actuators=actuators, joint_friction=friction, **changes)
    zeros = np.zeros(hand.n_q)
    shape, losses = JointShape(zeros, zeros, 0.0), CableLosses(0.0, 0.0, 0.0, zeros)
    return hand, Transmission(real, creep, shape, losses)


def torque(transmission, q, motor):
    """What the drives of :class:`Transmission` give at ``q``."""
    return transmission.drive_stiffness * (transmission.drive_targets(q, motor) - q)


def flexed(hand, generator):
    return hand.joint_lower + generator.uniform(0.2, 0.6, hand.n_q) * (hand.joint_upper - hand.joint_lower)


def test_couplings_hold_for_the_joints_that_lead():
    hand, _ = make()
    S = coupled_posture(hand.coupling)
    np.testing.assert_allclose(hand.coupling @ S, 0.0, atol=1e-12)
    np.testing.assert_allclose(S @ S, S, atol=1e-12)
    assert S[hand.joint_names.index("index_0"), hand.joint_names.index("index_0")] == 1.0


def test_a_slack_tendon_does_not_push_and_a_looped_cable_does():
    hand, transmission = make()
    q = flexed(hand, np.random.default_rng(1))
    q = coupled_posture(hand.coupling) @ q
    motor = hand.actuator_offset + hand.actuation_jacobian @ q
    distal, proximal = hand.actuator_names.index("index_distal"), hand.actuator_names.index("index_proximal")
    motor[[distal, proximal]] -= 0.2
    torques = transmission.actuator_torque(q, motor)
    assert torques[distal] == 0.0
    assert torques[proximal] == pytest.approx(-0.8)
    j2 = hand.joint_names.index("index_2")
    spring = -hand.spring_stiffness[j2] * (q[j2] - hand.spring_rest[j2])
    assert torque(transmission, q, motor)[j2] == pytest.approx(spring)


def test_friction_holds_up_to_its_torque_and_no_further():
    hand, transmission = make(friction=0.02)
    _, smooth = make()
    joint = hand.joint_names.index("thumb_1")
    q = coupled_posture(hand.coupling) @ flexed(hand, np.random.default_rng(2))
    motor = hand.actuator_offset + hand.actuation_jacobian @ q + 0.05
    transmission.relax(q)
    for offset, expected in ((0.001, 0.003), (0.02, 0.02), (0.2, 0.02), (0.19, -0.01), (0.1, -0.02)):
        moved = q.copy()
        moved[joint] += offset
        resisting = torque(smooth, moved, motor)[joint] - torque(transmission, moved, motor)[joint]
        assert resisting == pytest.approx(expected, abs=1e-9)


def test_lengthened_tendons_slacken_and_cables_do_not():
    hand, transmission = make()
    q = coupled_posture(hand.coupling) @ flexed(hand, np.random.default_rng(3))
    motor = hand.actuator_offset + hand.actuation_jacobian @ q + 0.1
    before = transmission.stretch(q, motor)
    transmission.lengthen(0.03)
    tendon = np.array([actuator.tendon for actuator in hand.actuators])
    np.testing.assert_allclose(before - transmission.stretch(q, motor), 0.03 * tendon, atol=1e-12)


def test_creep_follows_the_load():
    hand, transmission = make(creep=0.01)
    q = coupled_posture(hand.coupling) @ flexed(hand, np.random.default_rng(4))
    motor = hand.actuator_offset + hand.actuation_jacobian @ q + 0.1
    transmission.age(q, motor, duration=5.0)
    tendon = np.array([actuator.tendon for actuator in hand.actuators])
    np.testing.assert_allclose(
        transmission.offset - hand.actuator_offset, 0.01 * 5.0 * 0.4 * tendon, atol=1e-9
    )


def test_a_new_tendon_takes_over_the_torque_of_the_old():
    hand, old = make()
    _, new = make(actuation_jacobian=1.3 * hand.actuation_jacobian, stiffness=2.0)
    q = coupled_posture(hand.coupling) @ flexed(hand, np.random.default_rng(5))
    motor = hand.actuator_offset + hand.actuation_jacobian @ q + 0.1
    new.take_over(old, q, motor)
    np.testing.assert_allclose(torque(new, q, motor), torque(old, q, motor), atol=1e-12)
    assert np.abs(torque(new, q, motor + 0.1) - torque(old, q, motor + 0.1)).max() > 0.1


def resting_off_zero():
    """The iCub hand with another rest of its coupled joints: followers do not rest where leaders do."""
    hand, rest = load_hand("icub_right"), np.zeros(20)
    rest[hand.joint_names.index("ring_0")], rest[hand.joint_names.index("little_1")] = 0.1, -0.05
    return dataclasses.replace(hand, spring_rest=rest)


def test_couplings_hold_from_the_rest_on():
    hand, transmission = make(resting_off_zero())
    assert np.abs(hand.coupling @ hand.spring_rest).max() > 0.04
    at_rest = hand.actuator_offset + hand.actuation_jacobian @ hand.spring_rest
    np.testing.assert_allclose(transmission.stretch(hand.spring_rest, at_rest), 0, atol=1e-12)
    np.testing.assert_allclose(torque(transmission, hand.spring_rest, at_rest), 0, atol=1e-12)
    away = hand.spring_rest + coupled_posture(hand.coupling) @ np.full(hand.n_q, 0.2)
    motor = hand.actuator_offset + hand.actuation_jacobian @ away
    np.testing.assert_allclose(transmission.stretch(away, motor), 0, atol=1e-12)
    springs = -hand.spring_stiffness * (away - hand.spring_rest)
    np.testing.assert_allclose(torque(transmission, away, motor), springs, atol=1e-12)
    _, other = make(resting_off_zero(), stiffness=2.0)
    other.take_over(transmission, away, motor + 0.1)  # without a jolt
    np.testing.assert_allclose(
        torque(other, away, motor + 0.1), torque(transmission, away, motor + 0.1), atol=1e-9
    )
