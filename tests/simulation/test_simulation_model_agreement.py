"""Two independent implementations of one hand: PhysX and the kinematic model."""

import dataclasses

import numpy as np
import pytest
import torch
from simulation_helpers import DEG

from torch_ekm.description import load_hand
from torch_ekm.exceptions import ParameterError
from torch_ekm.kinematics.se3 import log
from torch_ekm.model import KinematicModel
from torch_ekm.simulation import PlantConfig, PlantParameters, SimulatedHand

STEP = 0.1 * DEG  # small enough that no contact slips


OTHER = PlantParameters(
    moment_arm=(1.0, 1.2, 0.9, 1.3, 1.1, 1.2, 1.0, 1.3, 1.0),
    spring=0.8,
    servo_stiffness=0.5,
    mass=1.5,
    com_shift=(0.005, 0.002, -0.003),
    object_scale=1.05,
)


@pytest.fixture(scope="module", params=[("can", PlantParameters()), ("box", OTHER)])
def grasp(request):
    """The model is told what the plant is, be it as described or not."""
    name, parameters = request.param
    config = PlantConfig(gravity=(2.0, 3.0, 9.0))
    plant = SimulatedHand("icub_right", name, config, parameters)
    truth = plant.reset(0).truth
    hand, obj = plant.true_descriptions()
    model = KinematicModel(hand, obj)
    return plant, truth, model.linearize(truth.state)


def test_detected_contacts_are_where_the_simulator_touches(grasp):
    _, _, linear = grasp
    assert linear.contacts.finger == ("thumb", "index", "middle")
    assert linear.contacts.gap.abs().max() < 5e-6


def test_forces_of_the_model_are_those_of_the_simulator(grasp):
    _, truth, linear = grasp
    torch.testing.assert_close(linear.forces.normal, truth.fingertip_force[:3], rtol=0.05, atol=0.02)
    torch.testing.assert_close(-linear.forces.lam, truth.actuator_torque, rtol=0.05, atol=0.01)
    assert linear.forces.residual.abs().max() < 1e-4  # [N m] of about 0.1


def test_manipulation_jacobian_is_what_the_simulator_does(grasp):
    plant, _, linear = grasp
    assert motion_error(plant, linear, range(plant.hand.n_a - 1)) < 0.03  # the pinky rests at its lower limit


def motion_error(plant, linear, actuators) -> float:
    """``|measured - predicted| / |predicted|`` of the object's motion per increment, rotations x 30 mm."""
    snapshot, measured = plant.snapshot(), []
    for k in actuators:
        ends = []
        for sign in (1.0, -1.0):
            plant.restore(snapshot)
            delta = torch.zeros(plant.hand.n_a, dtype=torch.float64)
            delta[k] = sign * STEP
            plant.command(delta)
            plant.wait(0.5)  # to a hundredth of this motion: more than is worth waiting for otherwise
            ends.append(plant.observe().truth)
        plus, minus = ends
        column = [plus.position - minus.position, log(plus.rotation @ minus.rotation.mT) * 0.03]
        measured.append(torch.cat(column).numpy() / (2 * STEP))
    measured = np.array(measured).T
    predicted = linear.object_jacobian[:, actuators].numpy() * np.array([[1.0]] * 3 + [[0.03]] * 3)
    return float(np.linalg.norm(predicted - measured) / np.linalg.norm(predicted))


@pytest.mark.parametrize("stiffness", [np.inf, 1e6])
def test_a_hand_with_rigid_actuators_moves_as_it_is_described(stiffness):
    hand = with_stiffness(load_hand("planar_two_finger"), ("left", "right"), stiffness)
    plant = SimulatedHand(hand, "box", PlantConfig(gravity=(0, -9.81, 0)))
    linear = KinematicModel(plant.hand, plant.object).linearize(plant.reset(0).truth.state)
    assert motion_error(plant, linear, [0, 1]) < 0.01  # measured .004; .035 at 8 N m/rad


def test_rigid_actuators_are_as_stiff_whatever_their_gear_and_need_small_steps():
    hand = with_stiffness(load_hand("planar_two_finger"), ("left",), np.inf)
    geared = dataclasses.replace(hand, actuation_jacobian=20.0 * hand.actuation_jacobian)
    at_joints = []
    for one in (hand, geared):
        true = SimulatedHand(one, "box").true_descriptions()[0]
        at_joints.append(true.actuators[0].stiffness * np.square(true.actuation_jacobian[0]).max())
    assert at_joints == pytest.approx([100.0, 100.0])
    with pytest.raises(ParameterError, match=r"time_step.*rigid"):
        SimulatedHand(hand, "box", PlantConfig(time_step=0.004))


def with_stiffness(hand, names, stiffness):
    actuators = (
        dataclasses.replace(actuator, stiffness=stiffness) if actuator.name in names else actuator
        for actuator in hand.actuators
    )
    return dataclasses.replace(hand, actuators=tuple(actuators))
