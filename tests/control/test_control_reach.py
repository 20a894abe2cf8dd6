"""How far a grasp can be turned, by the model: against the simulated hand without mismatch."""

import copy
import dataclasses
import math

import pytest
import torch

from torch_ekm.control import (
    ClosedLoop,
    Direction,
    FocusedPose,
    ForceSensitivity,
    LookAndMoveController,
    ModelHand,
    PathEnd,
    PoseTarget,
)
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import NoContactError, ParameterError
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation, PlantStatus
from torch_ekm.simulation import SimulatedHand, preset

DEG = math.pi / 180


@pytest.fixture(scope="module")
def grasp() -> tuple[SimulatedHand, Observation, LookAndMoveController]:
    """A wide tin in the hand as described."""
    plant = SimulatedHand("icub_right", "tea_tin", preset="none")
    seen = plant.reset(0)
    return plant, seen, LookAndMoveController(KinematicModel(plant.hand, plant.object), plant.rotation_axis)


def turned(axis: torch.Tensor, start: GraspState, now: GraspState) -> float:
    return float(axis @ now.minus(start)[-3:])


def test_the_model_hand_goes_where_the_simulated_one_goes(grasp) -> None:
    plant, _, controller = grasp
    seen = plant.reset(0)
    model = ModelHand(controller.kinematic, seen.state, seen.a, seen.fingertip_force)
    target = PoseTarget.turned(seen.state, plant.rotation_axis, degrees=10)
    controller.reset()
    for _ in range(5):
        predicted = model.observe()
        da = controller.decide(predicted.state, predicted.a, target, predicted.fingertip_force).delta_a
        predicted, seen = model.command(da), plant.command(da)
    error = predicted.state.minus(seen.truth.state)[-6:]
    assert float(error[3:].norm()) < 1.0 * DEG
    assert float(error[:3].norm()) < 1.0e-3
    assert float((predicted.fingertip_force - seen.truth.fingertip_force).abs().max()) < 0.6


def test_joints_keep_their_stops_and_encoders_their_ranges(grasp) -> None:
    plant, seen, controller = grasp
    model = ModelHand(controller.kinematic, seen.state, seen.a, seen.fingertip_force)
    hand, push = plant.hand, torch.zeros(plant.hand.n_a, dtype=torch.float64)
    push[hand.actuator_names.index("thumb_proximal")] = -0.5
    assert not model.at_stops()
    seen = model.command(push)
    assert "thumb_1" in model.at_stops()
    assert bool((seen.q >= torch.from_numpy(hand.joint_lower) - 1e-4).all())
    assert bool((seen.q <= torch.from_numpy(hand.joint_upper) + 1e-4).all())
    assert bool((seen.a >= torch.from_numpy(hand.actuator_lower) - 1e-12).all())
    if model.failure:
        assert seen.status is PlantStatus.LOST
        assert torch.equal(model.command(-push).q, seen.q)  # nothing is predicted of what was lost
    assert model.reset(0).status is PlantStatus.HELD


def test_a_turn_ends_where_the_model_said(grasp) -> None:
    plant = grasp[0]
    seen = plant.reset(3)  # with 0 rounding decides how the path ends
    controller = LookAndMoveController(grasp[2].kinematic, plant.rotation_axis)
    reach = ClosedLoop(plant, controller).reach()
    assert reach.end.kind in (PathEnd.FRICTION, PathEnd.LINK)
    assert str(reach) == f"{reach.angle / DEG:.1f} deg ({reach.end})"
    assert "no equilibrium is near" in reach.end.message
    along = [turned(plant.rotation_axis, seen.state, state) for state in reach.plan.states]
    assert along[-1] == max(along)
    assert [along[-1], along[reach.plan.safe]] == pytest.approx([reach.angle, reach.safe])
    assert reach.safe < reach.angle
    loop = ClosedLoop(plant, controller, decline=False)
    done = loop.run(PoseTarget.turned(seen.state, plant.rotation_axis, degrees=60))
    real = max(turned(plant.rotation_axis, seen.state, step.after.state) for step in done.steps)
    assert not done.lost
    assert reach.safe < real < reach.angle + 3 * DEG
    plant.reset(3)
    other = ClosedLoop(plant, controller).reach(sign=-1)
    assert other.angle < other.safe < 0
    assert "index_2" in str(other)


def test_forces_answer_as_they_were_learned_to(grasp) -> None:
    plant, _, controller = grasp
    seen = plant.reset(0)
    known = ForceSensitivity(len(plant.hand.pads), plant.hand.n_a)
    known.theta[:, 0] = -0.75
    controller.reset()
    target = PoseTarget.turned(seen.state, plant.rotation_axis, degrees=10)
    da = controller.decide(seen.state, seen.a, target, seen.fingertip_force).delta_a
    model, force = controller.kinematic, seen.fingertip_force
    change, learned = (
        ModelHand(model, seen.state, seen.a, force, forces).command(da).fingertip_force - force
        for forces in (None, known)
    )
    assert float(change.abs().max()) > 0.2
    torch.testing.assert_close(learned, 0.25 * change)


def test_what_cannot_be_asked_is_refused(grasp) -> None:
    plant, _, controller = grasp
    seen = plant.reset(0)
    loop = ClosedLoop(plant, controller)
    with pytest.raises(ParameterError, match="sign"):
        loop.reach(sign=0)
    with pytest.raises(ParameterError, match="limit"):
        loop.reach(limit=4.0)
    away = ModelHand(controller.kinematic, seen.state, seen.a)
    away.state = dataclasses.replace(seen.state, position=seen.position + 0.2)
    with pytest.raises(NoContactError):
        ClosedLoop(away, controller).reach()
    whole = copy.copy(controller)
    whole.focus = FocusedPose([Direction(axis, "mm") for axis in torch.eye(3)])
    with pytest.raises(ParameterError, match="one axis"):
        ClosedLoop(plant, whole).reach()


def test_a_planar_hand_reaches_as_far_as_its_plane_lets_it() -> None:
    """Two pads hold no moment about the line through them, nor has a plane of motion any."""
    plant = SimulatedHand("planar_two_finger", "can", preset="none")
    plant.reset(0)
    controller = LookAndMoveController(KinematicModel(plant.hand, plant.object), plant.rotation_axis)
    assert ClosedLoop(plant, controller).reach(limit=12 * DEG).angle > 5 * DEG


@pytest.mark.parametrize("off", ["pad", "object"])
def test_a_pad_or_an_object_that_is_described_wrongly_by_millimetres_is_turned(off: str) -> None:
    """The index pad is 3 mm thicker than described, or the object 15 % larger: nothing touches by f."""
    scale = 1.15 if off == "object" else 1.0
    parameters = preset("nominal").replace(object_scale=scale)
    plant = SimulatedHand("icub_right", "can", engine="mujoco", parameters=parameters)
    seen, hand = plant.reset(0), plant.hand
    if off == "pad":
        thin = (
            dataclasses.replace(pad, radius=pad.radius - 0.003 * (pad.name == "index")) for pad in hand.pads
        )
        hand = dataclasses.replace(hand, pads=tuple(thin))
    ekm = EnhancedModel.for_grasp(KinematicModel(hand, plant.object), seen.state)
    loop = ClosedLoop(plant, LookAndMoveController(ekm, plant.rotation_axis))
    done = loop.run(PoseTarget.turned(seen.state, plant.rotation_axis, degrees=8))
    assert done.reason.value == "reached"
