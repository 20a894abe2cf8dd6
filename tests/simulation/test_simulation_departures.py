"""Tendons, couplings, springs and friction without a physics engine, and what a plant may have instead."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from torch_ekm.description import HandDescription, load_hand
from torch_ekm.simulation import PlantParameters, SimulatedHand
from torch_ekm.simulation.mechanism.assembly import make_transmission
from torch_ekm.simulation.mechanism.transmission import JointShape, Transmission, coupled_posture
from torch_ekm.simulation.sensors import Sensors

HAND = load_hand("icub_right")
N_Q, STIFFNESS = HAND.n_q, 4.0
ARMED = np.flatnonzero(HAND.actuation_jacobian.any(axis=0))
TENDON = np.array([actuator.tendon for actuator in HAND.actuators])
ROUND, NO_PLAY = JointShape(np.zeros(N_Q), np.zeros(N_Q), 0.0), np.zeros(N_Q)


def make(
    shape: JointShape = ROUND,
    play: np.ndarray = NO_PLAY,
    *,
    losses: PlantParameters = PlantParameters(),  # noqa: B008
    hand: HandDescription = HAND,
    stiffness: float = STIFFNESS,
    friction: float = 0.0,
    **changes: Any,
) -> Transmission:
    actuators = tuple(dataclasses.replace(actuator, stiffness=stiffness) for actuator in hand.actuators)
    changes |= {"actuators": actuators, "joint_friction": np.full(N_Q, friction)}
    return Transmission(dataclasses.replace(hand, **changes), losses, shape, play)


def flexed(seed: int = 0) -> np.ndarray:
    """A posture that the couplings allow."""
    part = np.random.default_rng(seed).uniform(0.2, 0.6, N_Q)
    return coupled_posture(HAND.coupling) @ (HAND.joint_lower + part * (HAND.joint_upper - HAND.joint_lower))


def torque(transmission: Transmission, q: np.ndarray, motor: np.ndarray) -> np.ndarray:
    """What the drives give at ``q``."""
    return transmission.drive_stiffness * (transmission.drive_targets(q, motor) - q)


def taut(transmission: Transmission, q: np.ndarray, by: float = 0.1) -> np.ndarray:
    """Motors that stretch all tendons by so much."""
    return transmission.offset + transmission.J_a @ transmission.shape.excursion(q) + by


def test_the_drives_give_the_gradient_of_the_energy_of_odd_pulleys_springs_and_coupled_tendons() -> None:
    free = HAND.coupling.reshape(-1, N_Q).any(axis=0)
    draw = np.random.default_rng(1)
    shape = JointShape(np.where(free, 0.0, 0.25), draw.uniform(-3, 3, N_Q), 0.5)
    coupling = 0.2
    transmission = make(shape, losses=PlantParameters(tendon_coupling=coupling))
    S, q = coupled_posture(HAND.coupling), flexed()
    motor = taut(transmission, q)
    compliance = (np.eye(HAND.n_a) * (1 - coupling) + coupling) / STIFFNESS

    def excursion(x: np.ndarray) -> np.ndarray:  # the arms, integrated numerically
        t = (np.arange(400) + 0.5) / 400
        arms = 1 + shape.variation * np.sin(2 * t[:, None] * x + shape.phase)
        return x * arms.mean(axis=0)

    def energy(x: np.ndarray) -> float:
        stretch = motor - HAND.actuator_offset - HAND.actuation_jacobian @ S @ excursion(x)
        y, away = x - HAND.spring_rest, x - S @ x
        spring = HAND.spring_stiffness @ (y**2 / 2 + 0.5 * y**4 / 4)
        return spring + (stretch @ np.linalg.solve(compliance, stretch) + 8.0 * away @ away) / 2

    step = 1e-5
    gradient = [(energy(q + step * e) - energy(q - step * e)) / (2 * step) for e in np.eye(N_Q)]
    np.testing.assert_allclose(torque(transmission, q, motor), -np.array(gradient), atol=1e-6)
    pulls = transmission.actuator_torque(q, motor)
    np.testing.assert_allclose(transmission.stretched(pulls), transmission.stretch(q, motor), atol=1e-12)


def test_a_slack_tendon_neither_pushes_nor_shares_its_slack() -> None:
    transmission = make(losses=PlantParameters(tendon_coupling=0.2))
    q = flexed()
    motor = taut(transmission, q, 0.05)
    pulling = np.flatnonzero(TENDON)
    assert len(pulling) > 1
    motor[pulling[0]] -= 1.0
    pulls = transmission.actuator_torque(q, motor)
    assert pulls[pulling[0]] == 0.0
    rest = np.delete(np.arange(HAND.n_a), pulling[0])
    compliance = (np.eye(HAND.n_a - 1) * 0.8 + 0.2) / STIFFNESS
    np.testing.assert_allclose(compliance @ pulls[rest], 0.05, atol=1e-12)
    cable = np.flatnonzero(~TENDON)[0]
    motor[cable] -= 0.25  # a looped cable pushes
    assert make().actuator_torque(q, motor)[cable] == pytest.approx(-0.8)


def test_hysteresis_holds_a_share_of_the_pull_against_either_direction() -> None:
    transmission = make(losses=PlantParameters(hysteresis=0.1))
    q, plain = flexed(), make()
    held = []
    for by in (0.05, 0.2, 0.2):  # from below, then from above
        torque(transmission, q, taut(transmission, q, by))
    for by in (0.1, 0.1):
        held.append(torque(transmission, q, taut(transmission, q, by)) - torque(plain, q, taut(plain, q, by)))
    cables = 0.1 * STIFFNESS * HAND.actuation_jacobian.sum(axis=0)
    np.testing.assert_allclose(held[-1][ARMED], -0.05 * (cables @ coupled_posture(HAND.coupling))[ARMED])


def test_cable_friction_is_a_share_of_what_the_cables_turn_a_joint_with() -> None:
    transmission = make(losses=PlantParameters(cable_friction=0.1))
    q = flexed()
    motor = taut(transmission, q)
    cables = STIFFNESS * 0.1 * (HAND.actuation_jacobian.sum(axis=0) @ coupled_posture(HAND.coupling))
    ends = []
    for direction in (1.0, -1.0):
        transmission.relax(q - 0.2 * direction)
        ends.append(torque(transmission, q, motor))
    np.testing.assert_allclose((ends[1] - ends[0])[ARMED], 2 * 0.1 * np.abs(cables)[ARMED], rtol=1e-9)


def test_no_torque_goes_through_a_joint_within_its_play() -> None:
    play = np.zeros(N_Q)
    joint = HAND.joint_names.index("index_2")
    play[joint] = 0.06
    transmission, plain = make(play=play), make()
    q = flexed()
    motor = taut(plain, q, 0.0)
    balanced = q.copy()
    for _ in range(200):  # where the joint rests without play
        balanced[joint] = plain.drive_targets(balanced, motor)[joint]
    for off, through in ((0.02, 0.0), (-0.02, 0.0), (0.05, 0.02), (-0.05, -0.02)):
        at = balanced.copy()
        at[joint] += off
        transmission.relax(at)
        for _ in range(3):
            found = torque(transmission, at, motor)[joint]
        beyond = balanced.copy()
        beyond[joint] += through
        assert found == pytest.approx(torque(plain, beyond, motor)[joint], abs=1e-9)


def test_each_hardware_instance_has_its_own_shapes_and_play() -> None:
    figures = {"arm_variation": 0.25, "arm_phase": math.pi, "joint_play": 0.02, "spring_stiffening": 0.5}
    one, same, other = (
        make_transmission(HAND, PlantParameters(hardware_seed=seed, **figures)) for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(one.shape.phase, same.shape.phase)
    assert (one.shape.phase != other.shape.phase).all()
    coupled = HAND.coupling.reshape(-1, N_Q).any(axis=0)
    assert (one.play > 0).sum() == 3  # ring and little finger have couplings only
    assert not one.play[coupled].any()
    assert (one.shape.variation[coupled] == 0).all()
    assert (one.shape.variation[~coupled] == 0.25).all()


def test_fingertips_scale_and_drift() -> None:
    figures = PlantParameters(force_scale=2.0, force_drift=0.1, hardware_seed=5)
    sensors = Sensors(figures, N_Q, 5, HAND.joint_names)
    normal, draw = np.full(5, 4.0), np.random.default_rng(0)
    begin, later = sensors.forces(normal, 0.0, draw), sensors.forces(normal, 10.0, draw)
    assert ((begin > 2.0) & (begin < 8.0)).all()
    assert np.unique(begin).size == 5
    rate = (later - begin) / 10
    assert (np.abs(rate) <= 0.1).all()
    assert np.abs(rate).max() > 0.02


def at_rest(engine: str = "sapien", **figures: float) -> tuple[float, float, int]:
    """A grasp of the box: force of the thumb [N], depth of its pad in the box [mm], fingers that touch."""
    plant = SimulatedHand("icub_right", "box", parameters=PlantParameters(**figures), engine=engine)
    seen = plant.reset(seed=0)
    from torch_ekm.model import KinematicModel

    contacts = KinematicModel(plant.hand, plant.object).linearize(seen.truth.state).contacts
    k = contacts.finger.index(plant.hand.pads[0].name)
    return float(seen.truth.fingertip_force[0]), -1e3 * float(contacts.gap[k]), len(contacts.finger)


@pytest.mark.parametrize(
    "figures",
    [
        {"arm_variation": 0.25, "spring_stiffening": 0.5, "tendon_coupling": 0.1},
        {"arm_variation": -0.25, "spring_stiffening": -0.3, "joint_play": 0.03},
    ],
)
def test_the_planner_knows_the_plant(figures) -> None:
    force, _, fingers = at_rest(**figures)
    assert fingers == 3
    assert force == pytest.approx(5.0, abs=0.6)


@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
def test_pads_give_way_by_force_over_stiffness(engine: str) -> None:
    force, depth, _ = at_rest(engine, contact_stiffness=5e3)
    assert depth == pytest.approx(1e3 * force / 5e3, rel=0.15)
    assert abs(at_rest(engine)[1]) < 0.2


def test_one_side_of_the_object_has_less_friction() -> None:
    sides = set()
    for seed in (0, 1):  # one for each side
        plant = SimulatedHand(
            "icub_right", "box", parameters=PlantParameters(friction_unevenness=0.4, hardware_seed=seed)
        )
        plant.reset(seed=0)
        scene = plant._grasped().scene
        mean = (scene._opposed.static_friction + scene._material.static_friction) / 2
        sides.add((round(scene._material.static_friction, 6), round(mean, 6)))
        plant.close()
    mu = plant.object.friction
    assert sides == {(mu, round(0.6 * mu, 6)), (round(0.6 * mu, 6), mu)}


def test_a_law_of_ones_own_adds_its_torques_and_each_grasp_has_a_copy_of_it() -> None:
    class Law:
        calls = 0

        def __call__(self, q: np.ndarray, pull: np.ndarray) -> np.ndarray:
            self.calls += 1
            return -0.1 * q + pull @ HAND.actuation_jacobian * 0.5

    q, mine = flexed(), Law()
    plain, own = (make_transmission(HAND, PlantParameters(joint_law=law)) for law in (None, mine))
    motor = taut(plain, q)
    law = -0.1 * q + plain.actuator_torque(q, motor) @ HAND.actuation_jacobian * 0.5
    np.testing.assert_allclose(torque(own, q, motor), torque(plain, q, motor) + law, atol=1e-12)
    assert (own.law.calls, mine.calls) == (1, 0)


def test_couplings_hold_for_the_joints_that_lead():
    S = coupled_posture(HAND.coupling)
    np.testing.assert_allclose(HAND.coupling @ S, 0.0, atol=1e-12)
    np.testing.assert_allclose(S @ S, S, atol=1e-12)
    assert S[HAND.joint_names.index("index_0"), HAND.joint_names.index("index_0")] == 1.0


def test_friction_holds_up_to_its_torque_and_no_further():
    transmission, smooth, q = make(friction=0.02), make(), flexed(2)
    joint, motor = HAND.joint_names.index("thumb_1"), taut(smooth, q, 0.05)
    transmission.relax(q)
    for offset, expected in ((0.001, 0.003), (0.02, 0.02), (0.2, 0.02), (0.19, -0.01), (0.1, -0.02)):
        moved = q.copy()
        moved[joint] += offset
        resisting = torque(smooth, moved, motor)[joint] - torque(transmission, moved, motor)[joint]
        assert resisting == pytest.approx(expected, abs=1e-9)


def test_lengthened_tendons_slacken_and_cables_do_not():
    transmission, q = make(), flexed(3)
    motor = taut(transmission, q)
    before = transmission.stretch(q, motor)
    transmission.lengthen(0.03)
    np.testing.assert_allclose(before - transmission.stretch(q, motor), 0.03 * TENDON, atol=1e-12)


def test_creep_follows_the_load():
    transmission, q = make(losses=PlantParameters(tendon_creep=0.01)), flexed(4)
    transmission.age(q, taut(transmission, q), duration=5.0)
    grown = transmission.offset - HAND.actuator_offset
    np.testing.assert_allclose(grown, 0.01 * 5.0 * 0.4 * TENDON, atol=1e-9)


def test_a_new_tendon_takes_over_the_torque_of_the_old():
    old, q = make(), flexed(5)
    new = make(actuation_jacobian=1.3 * HAND.actuation_jacobian, stiffness=2.0)
    motor = taut(old, q)
    new.take_over(old, q, motor)
    np.testing.assert_allclose(torque(new, q, motor), torque(old, q, motor), atol=1e-12)
    assert np.abs(torque(new, q, motor + 0.1) - torque(old, q, motor + 0.1)).max() > 0.1


def test_couplings_hold_from_the_rest_on():
    """Followers that do not rest where leaders do."""
    rest = np.zeros(N_Q)
    rest[HAND.joint_names.index("ring_0")], rest[HAND.joint_names.index("little_1")] = 0.1, -0.05
    hand = dataclasses.replace(HAND, spring_rest=rest)
    transmission, other = make(hand=hand), make(hand=hand, stiffness=2.0)
    assert np.abs(hand.coupling @ rest).max() > 0.04
    away = rest + coupled_posture(hand.coupling) @ np.full(N_Q, 0.2)
    for q in (rest, away):
        motor = hand.actuator_offset + hand.actuation_jacobian @ q
        np.testing.assert_allclose(transmission.stretch(q, motor), 0, atol=1e-12)
        springs = -hand.spring_stiffness * (q - rest)
        np.testing.assert_allclose(torque(transmission, q, motor), springs, atol=1e-12)
    other.take_over(transmission, away, motor + 0.1)  # without a jolt
    same = torque(other, away, motor + 0.1), torque(transmission, away, motor + 0.1)
    np.testing.assert_allclose(*same, atol=1e-9)
