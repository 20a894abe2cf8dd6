"""One plant, two engines: what holds in MuJoCo as in SAPIEN."""

from typing import Any

import numpy as np
import pytest
import torch
from turning_step import true_state, turning_step

from torch_ekm.exceptions import UnknownNameError
from torch_ekm.experiments.config import Setting
from torch_ekm.kinematics.se3 import log
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation, PlantStatus
from torch_ekm.simulation import SimulatedHand, preset

DEG = np.pi / 180


def angle(first: Observation, second: Observation) -> float:
    """[deg] between the object's true orientations."""
    return float(log(first.truth.rotation @ second.truth.rotation.T).norm()) / DEG


def shift(first: Observation, second: Observation) -> float:
    """[mm] between its true positions."""
    return 1e3 * float((first.truth.position - second.truth.position).norm())


def mujoco_hand(name: str = "box", **options: Any) -> SimulatedHand:
    return SimulatedHand("icub_right", name, engine="mujoco", **options)


def test_the_kinematic_model_predicts_both_alike() -> None:
    """Three steps of 1.5 deg, nothing unknown: what is left is small in both engines."""
    errors = {}
    for engine in ("sapien", "mujoco"):
        plant = SimulatedHand("icub_right", "box", engine=engine)
        observation, found = plant.reset(11), []
        model, axis, state, grip = KinematicModel(plant.hand, plant.object), plant.rotation_axis, None, None
        for _ in range(3):
            state = true_state(observation) if state is None else state
            lin = model.linearize(state)
            grip = lin.forces.normal if grip is None else grip
            da = turning_step(lin, axis, 1.5 * DEG, grip)
            observation = plant.command(da)
            after = true_state(observation)
            found.append(float((after.minus(state) - lin.step(da))[-3:].norm()) / DEG)
            state = after
        assert plant.status is PlantStatus.HELD
        errors[engine] = float(np.mean(found))
    assert max(errors.values()) < 0.05, errors


def test_two_springs_and_a_tendon_are_where_the_forces_say() -> None:
    """A free planar finger: ``K_s (q - q0) = J_a^T k_a (m - a0 - J_a q)``."""
    plant = SimulatedHand("planar_two_finger", "can", engine="mujoco")
    plant.reset(0)
    rig = plant._grasped()
    rig.scene.place(rig.scene.q, np.array([0.0, 0.0, 1.0]), np.eye(3))
    rig.scene.hold_object(True)
    rig.follow(np.array([[0.5, 0.8]]), np.zeros(1))
    rig.wait(2.0)
    q, hand = rig.scene.q, plant.hand
    stretch = np.array([0.5, 0.8]) - hand.actuation_jacobian @ q
    torque = hand.actuation_jacobian.T @ (np.array([a.stiffness for a in hand.actuators]) * stretch)
    np.testing.assert_allclose(hand.spring_stiffness * (q - hand.spring_rest), torque, atol=1e-4)
    rig.transmission.lengthen(0.5)  # slack: a tendon does not push
    rig.follow(np.zeros((1, 2)), np.zeros(1))
    rig.wait(2.0)
    np.testing.assert_allclose(rig.scene.q, hand.spring_rest, atol=1e-3)


def test_friction_holds_until_its_cone() -> None:
    """Pulled along the pads with less and with more than friction bears."""
    plant = mujoco_hand()
    plant.reset(3)
    bears = 2 * plant.object.friction * float(plant._grasped().normal[0])
    axis = plant.rotation_axis.numpy()
    kept = plant.snapshot()
    before = plant.restore(kept)
    held = plant.tug(0.4 * bears * axis, np.zeros(3))
    plant.restore(kept)
    lost = plant.tug(2.5 * bears * axis, np.zeros(3))
    assert shift(before, held) < 1.0 < 3.0 < shift(before, lost)


def test_uneven_friction_is_that_of_the_side() -> None:
    plant = mujoco_hand(parameters=preset("none").replace(friction_unevenness=0.4))
    plant.reset(3)
    model = plant._grasped().scene._model  # type: ignore[attr-defined]
    values = sorted({round(float(mu), 6) for mu in model.pair_friction[:, 0]})
    assert values == pytest.approx([0.6 * plant.object.friction, plant.object.friction])


def test_a_planar_object_stays_in_its_plane() -> None:
    plant = SimulatedHand("planar_two_finger", "can", engine="mujoco")
    start = plant.reset(1)
    for _ in range(3):
        end = plant.command(torch.tensor([0.05, -0.05], dtype=torch.float64))
    turned = log(end.truth.rotation @ start.truth.rotation.T).numpy()
    assert abs(turned[2]) > 1 * DEG
    assert np.abs(turned[:2]).max() < 1e-9
    assert abs(float(end.truth.position[2] - start.truth.position[2])) < 1e-9


@pytest.mark.parametrize(
    "change", [{"mass": 3.0}, {"link_weight": True}, {"moment_arm": 1.2, "friction": 0.8}]
)
def test_changes_in_mid_run_do_in_both_the_same(change: dict[str, Any]) -> None:
    moved = []
    for engine in ("sapien", "mujoco"):
        plant = SimulatedHand("icub_right", "box", engine=engine)
        before = plant.reset(3)
        plant.change(**change)
        plant.wait(0.5)
        moved.append(angle(before, plant.observe()))
    assert (moved[0] > 0.1) == ("moment_arm" not in change)  # new tendons are put on without a jolt
    assert abs(moved[1] - moved[0]) < 0.02 + 0.03 * moved[0]


@pytest.mark.parametrize("make", [lambda name: SimulatedHand(engine=name), lambda name: Setting(engine=name)])
def test_an_unknown_engine_is_named_with_those_there_are(make: Any) -> None:
    with pytest.raises(UnknownNameError, match="sapien, mujoco"):
        make("bullet")


@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
def test_where_an_object_grows_broader_pads_touch_what_is_described(engine: str) -> None:
    """The flashlight's head begins beside the middle finger; a capsule's cap would reach under its pad."""
    plant = SimulatedHand("icub_right", "flashlight", engine=engine)
    truth = plant.reset(4).truth
    contacts = KinematicModel(plant.hand, plant.object).touching(truth.state)
    assert set(contacts.finger) == {"thumb", "index", "middle"}
    assert contacts.gap.abs().max() < 2e-4  # [m]; soft contacts give way by half of it
    plant.close()
