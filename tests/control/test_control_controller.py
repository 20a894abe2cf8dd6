"""The controller on the kinematic model of the simulated hand."""

import math

import numpy as np
import pytest
import torch

from torch_ekm.control import (
    DEFAULT_LIMITS,
    DEFAULT_TASKS,
    ActuatorLimit,
    Direction,
    EffortTask,
    FocusedPose,
    FocusTask,
    Inequality,
    JointLimit,
    LimitingFunction,
    LinearizedModel,
    LookAndMoveController,
    NormalForceLimit,
    OffAxisTask,
    PoseTarget,
    Situation,
    Squares,
    StopReason,
)
from torch_ekm.control.program import build_qp
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import NonFiniteError, ParameterError, ShapeError, UnknownNameError
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel, ModelStatus
from torch_ekm.residual import SparseOnlineGP

DEG = math.pi / 180
STEP = LimitingFunction().step


def controller(grasp, enhanced: bool = False, **parts) -> LookAndMoveController:
    plant, model, _, _ = grasp
    used = model
    if enhanced:
        learner = SparseOnlineGP(6 + plant.hand.n_a, 6)
        rows = list(range(plant.hand.n_q, plant.hand.n_q + 6))
        used = EnhancedModel(model, learner, encode=lambda s: s.minus(s)[..., -6:], outputs=rows)
    axis = FocusedPose.rotation_about(plant.rotation_axis)
    return LookAndMoveController(used, axis, **{"bound": None, **parts})


def test_zero_error_gives_almost_no_command(grasp) -> None:
    _, _, seen, state = grasp
    here = PoseTarget(state.position, state.rotation)
    decision = controller(grasp, tasks=(EffortTask(), OffAxisTask(), FocusTask())).decide(state, seen.a, here)
    assert decision.status is StopReason.RUNNING
    assert float(decision.delta_a.abs().max()) < 1e-4  # [rad]; an encoder a hair outside its range comes back


@pytest.mark.parametrize("enhanced", [False, True])
def test_prediction_meets_the_limited_error(grasp, enhanced: bool) -> None:
    plant, _, seen, state = grasp
    target = PoseTarget.turned(state, plant.rotation_axis, 10 * DEG)
    decision = controller(grasp, enhanced=enhanced).decide(state, seen.a, target, seen.fingertip_force)
    turn = float(plant.rotation_axis @ decision.predicted[-3:])
    assert float(decision.desired) == pytest.approx(STEP)
    # an untrained E-KM leaves what its damped iterations leave: 0.4^6
    assert turn == pytest.approx(STEP, rel=5e-3 if enhanced else 1e-5)
    torch.testing.assert_close(decision.predicted, decision.nominal)


def test_where_no_forces_are_found_those_of_the_same_grasp_stand_in(grasp) -> None:
    plant, model, seen, state = grasp
    contacts = model.contacts(state)
    slippery = contacts.replace(friction=torch.full_like(contacts.friction, 1e-4))
    shown = [contacts]
    forgetful = KinematicModel(
        plant.hand, plant.object, kinematics=model.kinematics, detector=lambda *_: shown[0]
    )
    loop = LookAndMoveController(forgetful, FocusedPose.rotation_about(plant.rotation_axis))
    target = PoseTarget.turned(state, plant.rotation_axis, 10 * DEG)

    def status() -> ModelStatus:
        return loop.decide(state, seen.a, target, seen.fingertip_force).linearization.status

    assert status() is ModelStatus.OK
    shown[0] = slippery
    assert [status(), status()] == [ModelStatus.REUSED_FORCES] * 2
    loop.reset()
    assert status() is ModelStatus.NO_FORCES


def test_forces_are_those_that_fingertips_and_the_last_decision_speak_for(grasp) -> None:
    plant, model, seen, state = grasp
    loop = controller(grasp)
    target = PoseTarget.turned(state, plant.rotation_axis, 10 * DEG)
    first = loop.decide(state, seen.a, target, seen.fingertip_force)
    moved = seen.a + 0.5 * first.delta_a
    second = loop.decide(state, moved, target, seen.fingertip_force).linearization
    expected = first.linearization.forces_after(moved - seen.a)
    alone = model.linearize(state, fingertip_force=seen.fingertip_force, expected=expected)
    assert torch.equal(second.forces.mu, alone.forces.mu)
    assert torch.equal(second.forces.covariance, alone.forces.covariance)
    assert not torch.allclose(second.forces.mu, first.linearization.forces.mu, atol=1e-3)
    loop.reset()
    again = loop.decide(state, seen.a, target, seen.fingertip_force).linearization
    assert torch.equal(again.forces.mu, first.linearization.forces.mu)


def test_limits_are_kept_and_told(grasp) -> None:
    plant, _, seen, state = grasp
    small = ActuatorLimit(0.05 * DEG, fixed=("thumb_oppose",))
    target = PoseTarget.turned(state, plant.rotation_axis, 20 * DEG)
    decision = controller(grasp, limits=(small,)).decide(state, seen.a, target, seen.fingertip_force)
    assert float(decision.delta_a.abs().max()) <= 0.05 * DEG + 1e-9
    assert decision.delta_a[plant.hand.actuator_names.index("thumb_oppose")] == 0
    assert decision.slack > 0.5 * DEG  # unreachable in one step: reported, not raised
    with pytest.raises(UnknownNameError, match="thumb_oppose"):
        controller(grasp, limits=(ActuatorLimit(fixed=("thumb",)),)).decide(state, seen.a, target)


def test_actuators_at_the_end_of_their_range_are_told(grasp) -> None:
    plant, _, seen, state = grasp
    target = PoseTarget.turned(state, plant.rotation_axis, 10 * DEG)
    short = controller(grasp, limits=(ActuatorLimit(0.05 * DEG),))
    free = short.decide(state, seen.a, target)
    assert free.slack > 0.1 * STEP
    assert not free.limited  # by the step, not by the end of a range
    lower, upper = (torch.from_numpy(x) for x in (plant.hand.actuator_lower, plant.hand.actuator_upper))
    a = torch.where(free.delta_a > 0, upper, lower).where(free.delta_a.abs() > 1e-6, seen.a)
    decision = short.decide(state, a, target)
    assert decision.limited
    after = a + decision.delta_a
    assert bool(((after <= upper + 1e-9) & (after >= lower - 1e-9)).all())


class HoldJoint:
    """A wish from outside the package: one joint keeps its angle."""

    def __init__(self, joint: int, weight: float = 1e3) -> None:
        self.joint, self.weight = joint, weight

    def rows(self, model: LinearizedModel, seen: Situation) -> Squares:
        j = [self.joint]
        return Squares(model.jacobian[j], -model.offset[j], self.weight, DEG)


class SlowJoint(HoldJoint):
    """A limit from outside: it closes by no more than 0.1 deg."""

    def rows(self, model: LinearizedModel, seen: Situation) -> Inequality:
        j = [self.joint]
        return Inequality(model.jacobian[j], 0.1 * DEG - model.offset[j], DEG)


@pytest.mark.parametrize("enhanced", [False, True])
def test_a_wish_and_a_limit_of_ones_own_have_effect(grasp, enhanced: bool) -> None:
    plant, _, seen, state = grasp
    target = PoseTarget.turned(state, plant.rotation_axis, 10 * DEG)
    plain = controller(grasp, enhanced).decide(state, seen.a, target, seen.fingertip_force)
    joint = int(plain.predicted[: plant.hand.n_q].argmax())
    closes = float(plain.predicted[joint])
    assert closes > 0.5 * DEG
    for part, most in (
        ({"tasks": (*DEFAULT_TASKS, HoldJoint(joint))}, 0.05 * closes),
        ({"limits": (*DEFAULT_LIMITS, SlowJoint(joint))}, 0.1 * DEG + 1e-4),
    ):
        decision = controller(grasp, enhanced, **part).decide(state, seen.a, target, seen.fingertip_force)
        assert abs(float(decision.predicted[joint])) <= most
        turn = float(plant.rotation_axis @ decision.predicted[-3:])
        assert turn == pytest.approx(STEP, rel=2e-2)  # and the turn is still made


@pytest.mark.usefixtures("unchecked")
def test_wrong_tasks_and_limits_are_refused(grasp) -> None:
    for wrong in ({"tasks": EffortTask()}, {"limits": 5 * DEG}):
        with pytest.raises(ParameterError, match=r"must be a list .*rows\(model, seen\)"):
            controller(grasp, **wrong)
    with pytest.raises(ParameterError, match="a KinematicModel, or an EnhancedModel around one"):
        LookAndMoveController(torch.sin, torch.ones(3))
    for wrong in ({"tasks": ["focus"]}, {"tasks": [EffortTask]}, {"limits": [5 * DEG]}):
        with pytest.raises(ParameterError, match=r"tasks, limits .*rows\(model, seen\)"):
            controller(grasp, **wrong)
    n_u = 3
    for rows, error, says in (
        (np.eye(n_u), ParameterError, "'ndarray' .* Squares, Equality, Inequality, Bounds or None"),
        (Squares(np.eye(n_u), np.zeros(n_u), -1.0), ParameterError, "weight"),
        (Squares(np.eye(2), np.zeros(2)), ShapeError, r"\(n, 3\)"),
        (Inequality(np.ones((1, 4)), np.zeros(1)), ShapeError, "rows of Inequality"),
    ):
        with pytest.raises(error, match=says):
            build_qp(n_u, [rows])


def test_without_a_focus_task_the_rest_is_done(grasp) -> None:
    plant, _, seen, state = grasp
    target = PoseTarget.turned(state, plant.rotation_axis, 10 * DEG)
    rest = [task for task in DEFAULT_TASKS if not isinstance(task, FocusTask)]
    decision = controller(grasp, tasks=rest).decide(state, seen.a, target, 0.5 * seen.fingertip_force)
    change = decision.linearization.normal_force_sensitivity @ decision.delta_a
    assert float(change.max()) > 0.3
    assert decision.slack == 0.0


def test_joints_stop_before_their_stops(grasp) -> None:
    plant, _, seen, state = grasp
    target = PoseTarget.turned(state, plant.rotation_axis, 10 * DEG)
    plain = controller(grasp).decide(state, seen.a, target, seen.fingertip_force)
    change = plain.predicted[: plant.hand.n_q]
    joint = int(change.argmax())
    stop = float(state.q[joint] + 0.3 * change[joint])  # in the midst of the way
    margin = float(plant.hand.joint_upper[joint]) - stop
    kept = controller(grasp, limits=(ActuatorLimit(), NormalForceLimit(), JointLimit(margin)))
    decision = kept.decide(state, seen.a, target, seen.fingertip_force)
    assert float(state.q[joint] + decision.predicted[joint]) <= stop + 1e-6


def test_no_contact_is_asked_to_travel_far(grasp) -> None:
    plant, _, seen, state = grasp
    target = PoseTarget.turned(state, plant.rotation_axis, 10 * DEG)
    limiting = LimitingFunction(contact_travel=0.4e-3)
    decision = controller(grasp, limiting=limiting).decide(state, seen.a, target, seen.fingertip_force)
    lever = decision.linearization.contacts.point - state.position
    lever = lever - (lever @ plant.rotation_axis)[:, None] * plant.rotation_axis
    farthest = float(torch.linalg.vector_norm(lever, dim=-1).max())
    assert float(decision.desired) * farthest == pytest.approx(0.4e-3)
    assert float(decision.desired) < 0.8 * STEP


def test_a_translation_carries_every_contact_as_far(grasp) -> None:
    _, model, seen, state = grasp
    focus = FocusedPose([Direction(axis, "mm") for axis in torch.eye(3)])
    target = PoseTarget(state.position + torch.tensor([3e-3, 4e-3, 0.0]), state.rotation)
    short = LimitingFunction(step=1.0, contact_travel=0.5e-3)
    decision = LookAndMoveController(model, focus, limiting=short, bound=None).decide(state, seen.a, target)
    torch.testing.assert_close(decision.desired, torch.tensor([0.3e-3, 0.4e-3, 0.0], dtype=torch.float64))
    free = LimitingFunction(gain=0.8, step=1.0, contact_travel=None)
    decision = LookAndMoveController(model, focus, limiting=free, bound=None).decide(state, seen.a, target)
    torch.testing.assert_close(decision.desired, 0.8 * torch.tensor([3e-3, 4e-3, 0.0], dtype=torch.float64))


def test_grasp_that_is_gone_is_a_status(grasp) -> None:
    _, _, seen, state = grasp
    away = GraspState(state.q, state.position + 0.5, state.rotation)
    target = PoseTarget(state.position, state.rotation)
    decision = controller(grasp).decide(away, seen.a, target, 0.0 * seen.fingertip_force)
    assert decision.status is StopReason.OBJECT_LOST
    assert float(decision.delta_a.abs().max()) == 0
    assert "touches" in decision.message
    decision = controller(grasp).decide(away, seen.a, target, seen.fingertip_force)
    assert decision.status is StopReason.UNSTABLE_GRASP
    assert "check the object's size and pose" in decision.message


def test_bad_observations_are_refused(grasp) -> None:
    _, _, seen, state = grasp
    target = PoseTarget(state.position, state.rotation)
    loop = controller(grasp)
    with pytest.raises(NonFiniteError, match="a must be finite"):
        loop.decide(state, seen.a * torch.nan, target)
    with pytest.raises(ShapeError, match=r"\(9,\)"):
        loop.decide(state, seen.a[:3], target)
    with pytest.raises(NonFiniteError, match="fingertip_force"):
        loop.decide(state, seen.a, target, seen.fingertip_force + np.inf)
    with pytest.raises(NonFiniteError, match="position"):
        GraspState(state.q, state.position * torch.nan, state.rotation)
