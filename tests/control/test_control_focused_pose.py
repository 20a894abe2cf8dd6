"""A focused pose of several directions with units: errors, steps, weights, and what is reachable."""

import math

import pytest
import torch

from torch_ekm.control import (
    ClosedLoop,
    Direction,
    EffortTask,
    FocusedPose,
    LimitingFunction,
    LookAndMoveController,
    PathEnd,
    PoseTarget,
    Safety,
    StoppingRule,
    StopReason,
)
from torch_ekm.control.ends import out_of_reach
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import NonFiniteError, ParameterError, ShapeError, UnknownNameError
from torch_ekm.kinematics import GraspState
from torch_ekm.kinematics.se3 import exp
from torch_ekm.model import KinematicModel
from torch_ekm.simulation import SimulatedHand

DEG = math.pi / 180
X, Y, Z = torch.eye(3, dtype=torch.float64)
HERE = GraspState(torch.zeros(4, dtype=torch.float64), 0.1 * X, exp(0.3 * Y))
TURN_AND_SHIFT = FocusedPose([Direction(Z, "deg"), Direction(X, "mm")])
SIX = [Direction(axis, unit) for unit in ("deg", "mm") for axis in (X, Y, Z)]


def target(degrees: float = 0.0, millimetres: float = 0.0) -> PoseTarget:
    return PoseTarget.moved(PoseTarget.turned(HERE, Z, degrees=degrees), X, millimetres=millimetres)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "error", "text"),
    [
        (lambda: Direction(X), UnknownNameError, "unknown unit ''; valid are: deg, mm"),
        (lambda: Direction(X, "rad"), UnknownNameError, "unit 'rad'"),
        (lambda: Direction(0 * X, "mm"), ParameterError, "non-zero"),
        (lambda: Direction(X, "mm", tolerance=0.0), ParameterError, "tolerance"),
        (lambda: Direction(X, "mm", step=math.nan), ParameterError, "step"),
        (lambda: FocusedPose([Direction(X, "mm"), Direction(-2 * X, "mm")]), ParameterError, "perpendicular"),
        (lambda: FocusedPose([Direction(X, "mm"), Direction(X + Y, "mm")]), ParameterError, "perpendicular"),
        (lambda: FocusedPose([]), ParameterError, "one to six"),
        (lambda: FocusedPose(Direction(X, "mm")), ParameterError, "a list of one to six Directions"),
        (lambda: FocusedPose([X, Y]), ParameterError, "a list of one to six Directions"),
        (lambda: Direction(X[:2], "deg"), ShapeError, "axis must have shape"),
        (lambda: Direction("deg", "mm"), ParameterError, "axis = .* must be numbers"),
        (lambda: Direction(X, "mm", tolerance="0.1"), ParameterError, "tolerance"),
        (lambda: PoseTarget.turned(X, HERE, degrees=1), ParameterError, "axis"),
        (lambda: PoseTarget(X, torch.ones(4)), ShapeError, "rotation"),
        (lambda: PoseTarget(torch.eye(3), X), ShapeError, "position"),
        (lambda: PoseTarget(X * math.nan, torch.eye(3)), NonFiniteError, "position"),
        (lambda: PoseTarget(X, 2 * torch.eye(3)), ParameterError, "a rotation matrix"),
        (lambda: PoseTarget.moved(HERE, X, millimetres=math.inf), NonFiniteError, "millimetres"),
        (lambda: FocusedPose.rotation_about(0 * X), ParameterError, "non-zero"),
        (lambda: PoseTarget.turned(HERE, X, math.nan), NonFiniteError, "angle"),
        (lambda: StoppingRule(max_steps=0), ParameterError, "max_steps"),
        (lambda: EffortTask(0.0), ParameterError, "positive"),
    ],
)
def test_bad_input_is_refused(make, error, text: str) -> None:
    with pytest.raises(error, match=text):
        make()


@pytest.mark.usefixtures("unchecked")
def test_lists_and_single_precision_are_taken() -> None:
    at, by = PoseTarget([0.1, 0.0, 0.0], torch.eye(3)), PoseTarget.turned(HERE, Z.float(), degrees=5)
    focus = FocusedPose([Direction([0, 0, 1], "deg"), Direction(X.float(), "mm")])
    assert focus.error(by, HERE) == TURN_AND_SHIFT.error(target(5.0), HERE)
    assert focus.error(at, HERE) == pytest.approx(0.0, abs=1e-12)  # turned about y alone


def test_error_of_a_turned_pose_is_the_turn() -> None:
    twist = PoseTarget.turned(HERE, 3 * (0.6 * X + 0.8 * Z), 0.4).error(HERE)
    torch.testing.assert_close(twist, torch.tensor([0, 0, 0, 0.24, 0, 0.32], dtype=torch.float64))


def test_focus_and_rest_span_all_directions() -> None:
    focus = FocusedPose.rotation_about(0.6 * X + 0.8 * Z)
    rows = torch.cat([focus.matrix, focus.off_matrix])
    torch.testing.assert_close(rows @ rows.mT, torch.eye(6, dtype=torch.float64))
    assert len(focus.matrix) == 1
    assert focus.off_translation.tolist() == [True] * 3 + [False] * 2


def test_a_turn_and_a_shift_are_named_by_their_units() -> None:
    assert FocusedPose([Direction(X, "deg"), Direction(X, "mm")]).matrix.shape == (2, 6)
    names = [str(one) for one in TURN_AND_SHIFT.directions]
    assert names == ["turn about (0, 0, 1)", "shift along (1, 0, 0)"]
    assert len(FocusedPose(SIX).off_matrix) == 0


def test_errors_of_both_units_count_by_their_tolerance() -> None:
    """No metres are added to radians: 0.2 mm miss the target as far as 0.25 deg do."""
    error = TURN_AND_SHIFT.error
    assert error(target(degrees=0.25), HERE) == pytest.approx(0.25 * DEG)
    assert error(target(millimetres=0.2), HERE) == pytest.approx(0.25 * DEG)
    assert error(target(1.0, 0.2), HERE) == pytest.approx(1.0 * DEG)
    assert error(target(1.0, -1.6), HERE) == pytest.approx(2.0 * DEG)
    fine = FocusedPose([Direction(Z, "deg", tolerance=0.5), Direction(X, "mm", tolerance=0.05)])
    assert fine.error(target(degrees=0.5), HERE) == pytest.approx(0.25 * DEG)
    assert fine.error(target(millimetres=0.05), HERE) == pytest.approx(0.25 * DEG)


def test_a_rotation_about_one_axis_counts_as_it_is() -> None:
    """Bit for bit: what was published with it holds."""
    focus, turned = FocusedPose.rotation_about(3 * Z), target(degrees=7.3)
    assert focus.error(turned, HERE) == abs(float(Z @ turned.error(HERE)[3:]))
    for scale in (focus.tolerance_scale, focus.step_scale):
        assert scale.tolist() == [1.0]


def controller(grasp, directions, tasks=None, **limiting) -> LookAndMoveController:
    limits = LimitingFunction(contact_travel=None, **limiting)
    return LookAndMoveController(grasp[1], FocusedPose(directions), tasks, limiting=limits, bound=None)


def test_a_step_of_both_keeps_its_direction_and_is_limited_by_each(grasp) -> None:
    plant, _, seen, state = grasp
    axis, along = plant.rotation_axis, torch.linalg.cross(plant.rotation_axis, X)
    both = PoseTarget.moved(PoseTarget.turned(state, axis, degrees=3), along, millimetres=4)
    for step, share in ((None, 1 / math.hypot(3 / 2.5, 4 / 2)), (0.5, 1 / math.hypot(3 / 2.5, 4 / 0.5))):
        chosen = controller(grasp, [Direction(axis, "deg"), Direction(along, "mm", step=step)])
        decision = chosen.decide(state, seen.a, both, seen.fingertip_force)
        asked = torch.tensor([3 * DEG, 4e-3], dtype=torch.float64)
        torch.testing.assert_close(decision.desired, share * asked, rtol=1e-6, atol=0)
        came = chosen.focus.matrix @ decision.predicted[-6:]
        torch.testing.assert_close(came, decision.desired, rtol=1e-4, atol=1e-9)


@pytest.fixture(scope="module")
def tin() -> tuple[SimulatedHand, KinematicModel]:
    plant = SimulatedHand("icub_right", "box", preset="none")
    plant.reset(3)
    return plant, KinematicModel(plant.hand, plant.object)


def loop_of(tin, directions) -> ClosedLoop:
    plant, model = tin
    safety = Safety(rule=StoppingRule(max_steps=25))
    return ClosedLoop(plant, LookAndMoveController(model, FocusedPose(directions)), safety=safety)


def test_what_the_motors_do_not_hold_is_declined_with_the_reason(tin) -> None:
    plant, _ = tin
    start = plant.reset(3).state
    loop, there = loop_of(tin, SIX), PoseTarget.turned(start, plant.rotation_axis, degrees=3)
    done = loop.run(there)
    assert done.reason is StopReason.OUT_OF_REACH
    assert not done.steps
    assert "5 of the 6 directions" in done.stop.message
    assert "shift along" in done.stop.message
    loop.decline = False
    assert next(loop.steps(there)).decision.status is StopReason.RUNNING


def test_what_is_too_far_is_declined_with_the_reason(tin) -> None:
    plant, _ = tin
    start = plant.reset(3).state
    a = plant.rotation_axis
    across = torch.linalg.cross(a, X)
    far = loop_of(tin, [Direction(across, "mm")]).run(PoseTarget.moved(start, across, millimetres=200))
    assert far.reason is StopReason.OUT_OF_REACH
    assert "to first order the whole ranges of the motors come" in far.stop.message


def test_how_far_a_shift_goes_a_plan_tells_and_j_m_does_not(tin) -> None:
    plant, model = tin
    start = plant.reset(3).state
    points, a = torch.as_tensor(plant.plan.points), plant.rotation_axis
    b = points[1:].mean(0) - points[0]
    b = b - a * (a @ b)
    chosen = LookAndMoveController(EnhancedModel.for_grasp(model, start), FocusedPose([Direction(b, "mm")]))
    loop = ClosedLoop(plant, chosen, learn=False)
    far, near = (PoseTarget.moved(start, b, millimetres=distance) for distance in (30, -8))
    assert not out_of_reach(chosen, plant.observe(), far)
    told = loop.plan(far)
    assert told.end.kind is not PathEnd.NOTHING
    assert "the path ends" in str(told)
    assert loop.run(near).reason is StopReason.REACHED


@pytest.mark.parametrize("asked", ["shift", "turn about another axis", "turn with shift"])
def test_what_is_called_reachable_is_reached(tin, asked: str) -> None:
    plant, _ = tin
    start = plant.reset(3).state
    a = plant.rotation_axis
    across = torch.linalg.cross(a, X) / torch.linalg.vector_norm(torch.linalg.cross(a, X))
    there = {
        "shift": PoseTarget.moved(start, across, millimetres=3),
        "turn about another axis": PoseTarget.turned(start, across, degrees=5),
        "turn with shift": PoseTarget.moved(PoseTarget.turned(start, a, degrees=5), across, millimetres=2),
    }[asked]
    directions = {
        "shift": [Direction(across, "mm")],
        "turn about another axis": [Direction(across, "deg")],
        "turn with shift": [Direction(a, "deg"), Direction(across, "mm")],
    }[asked]
    loop = loop_of(tin, directions)
    done = loop.run(there)
    assert done.reason is StopReason.REACHED
    wrong = done.focus.matrix @ there.error(done.stop.final.truth.state)
    for one, error in zip(directions, wrong.abs().tolist(), strict=True):
        assert error < (0.3 * DEG if one.unit == "deg" else 0.25e-3)


@pytest.mark.parametrize(
    ("errors", "limited", "reason"),
    [
        ([1.0], False, StopReason.RUNNING),
        ([1.0, 0.05], False, StopReason.RUNNING),  # looks decide on that
        ([1.0, 0.5, 0.49, 0.51, 0.5], False, StopReason.STALLED),
        ([1.0, 0.5, 0.49, 0.51, 0.5], True, StopReason.ACTUATOR_LIMITS),
        ([1.0, 0.8, 0.6, 0.4, 0.3], False, StopReason.RUNNING),
        ([3.0 - 0.1 * k for k in range(11)], False, StopReason.STEP_LIMIT),
    ],
)
def test_stopping_rule(errors: list[float], limited: bool, reason: StopReason) -> None:
    rule = StoppingRule(tolerance=0.1, stall_window=3, stall_progress=0.05, max_steps=10)
    assert rule.judge(errors, limited) is reason
