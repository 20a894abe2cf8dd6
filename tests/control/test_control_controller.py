"""The controller on the kinematic model of the simulated hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torch_ekm.control import (
    ControllerOptions,
    FocusedPose,
    LookAndMoveController,
    PoseTarget,
    StopReason,
)
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import NonFiniteError, ParameterError, ShapeError
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel, ModelStatus
from torch_ekm.residual import ActionLinearKernel, SparseOnlineGP, ZeroResidual
from torch_ekm.simulation import SimulatedHand

DEG = math.pi / 180
STEP = ControllerOptions().focus_step


@pytest.fixture(scope="module")
def grasp():
    """A held box: plant, kinematic model, first observation and its state."""
    plant = SimulatedHand("icub_right", "box")
    seen = plant.reset(seed=3)
    model = KinematicModel(plant.hand, plant.object)
    return plant, model, seen, GraspState(seen.q, seen.position, seen.rotation)


def controller(grasp, options: ControllerOptions | None = None, enhanced: bool = False):
    plant, model, _, _ = grasp
    used = model
    if enhanced:
        learner = SparseOnlineGP(6 + plant.hand.n_a, 6)
        rows = list(range(plant.hand.n_q, plant.hand.n_q + 6))
        used = EnhancedModel(model, learner, encode=lambda s: s.coordinates(s)[..., -6:], outputs=rows)
    return LookAndMoveController(used, FocusedPose.rotation_about(plant.rotation_axis), options)


def test_zero_error_gives_almost_no_command(grasp) -> None:
    _, _, seen, state = grasp
    here = PoseTarget(state.position, state.rotation)
    decision = controller(grasp, ControllerOptions(grip_force=None)).decide(state, seen.a, here)
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


def test_limits_are_kept_and_told(grasp) -> None:
    plant, _, seen, state = grasp
    options = ControllerOptions(actuator_step=0.05 * DEG, fixed_actuators=("thumb_oppose",))
    target = PoseTarget.turned(state, plant.rotation_axis, 20 * DEG)
    decision = controller(grasp, options).decide(state, seen.a, target, seen.fingertip_force)
    assert float(decision.delta_a.abs().max()) <= 0.05 * DEG + 1e-9
    assert decision.delta_a[plant.hand.actuator_names.index("thumb_oppose")] == 0
    assert decision.slack > 0.5 * DEG  # unreachable in one step: reported, not raised


def test_grip_rows_ask_for_the_missing_force(grasp) -> None:
    _, _, seen, state = grasp
    here = PoseTarget(state.position, state.rotation)
    weak = seen.fingertip_force * 0.5
    decision = controller(grasp).decide(state, seen.a, here, weak)
    change = decision.linearization.normal_force_sensitivity @ decision.delta_a
    thumb = decision.linearization.contacts.finger.index("thumb")
    assert float(change[thumb]) > 0.3


def test_limiting_function_keeps_direction() -> None:
    loop = LookAndMoveController.__new__(LookAndMoveController)
    loop.options = ControllerOptions(focus_step=1.0, focus_gain=0.5)
    error = torch.tensor([3.0, -4.0])
    torch.testing.assert_close(loop.limit(error), error / 5)
    torch.testing.assert_close(loop.limit(error / 10), error / 20)
    torch.testing.assert_close(loop.limit(error * 0), error * 0)


def test_no_contact_is_asked_to_travel_far(grasp) -> None:
    plant, _, seen, state = grasp
    target = PoseTarget.turned(state, plant.rotation_axis, 10 * DEG)
    options = ControllerOptions(contact_step=0.4e-3)
    decision = controller(grasp, options).decide(state, seen.a, target, seen.fingertip_force)
    lever = decision.linearization.contacts.point - state.position
    lever = lever - (lever @ plant.rotation_axis)[:, None] * plant.rotation_axis
    farthest = float(torch.linalg.vector_norm(lever, dim=-1).max())
    assert float(decision.desired) * farthest == pytest.approx(0.4e-3)
    assert float(decision.desired) < 0.8 * STEP


def test_a_translation_carries_every_contact_as_far(grasp) -> None:
    _, model, seen, state = grasp
    focus = FocusedPose(torch.eye(6, dtype=torch.float64)[:3])
    target = PoseTarget(state.position + torch.tensor([3e-3, 4e-3, 0.0]), state.rotation)
    options = ControllerOptions(focus_step=1.0, contact_step=0.5e-3)
    decision = LookAndMoveController(model, focus, options).decide(state, seen.a, target)
    torch.testing.assert_close(decision.desired, torch.tensor([0.3e-3, 0.4e-3, 0.0], dtype=torch.float64))
    free = ControllerOptions(focus_step=1.0, contact_step=None, focus_gain=0.8)
    decision = LookAndMoveController(model, focus, free).decide(state, seen.a, target)
    torch.testing.assert_close(decision.desired, 0.8 * torch.tensor([3e-3, 4e-3, 0.0], dtype=torch.float64))


def test_grasp_that_is_gone_is_a_status(grasp) -> None:
    _, _, seen, state = grasp
    away = GraspState(state.q, state.position + 0.5, state.rotation)
    target = PoseTarget(state.position, state.rotation)
    decision = controller(grasp).decide(away, seen.a, target, seen.fingertip_force)
    assert decision.status is StopReason.OBJECT_LOST
    assert float(decision.delta_a.abs().max()) == 0
    assert "touches" in decision.message


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


# -- uncertainty and friction margin -----------------------------------------------------------------


@pytest.fixture(scope="module")
def taught(grasp) -> EnhancedModel:
    """An E-KM with an action-linear kernel that knows some of the actuators well and others not at all."""
    plant, model, _, state = grasp
    n_q, n_a = plant.hand.n_q, plant.hand.n_a
    kernel = ActionLinearKernel(6 + n_a, n_a, action_variance=0.1)
    learner = SparseOnlineGP(6 + n_a, 6, kernel=kernel, noise_variance=0.05)
    scale = torch.tensor([1e3] * 3 + [1 / DEG] * 3, dtype=torch.float64)
    enhanced = EnhancedModel(
        model,
        learner,
        encode=lambda s: s.coordinates(state)[..., -6:],
        outputs=list(range(n_q, n_q + 6)),
        action_scale=1 / (2 * DEG),
        output_scale=scale,
    )
    generator = torch.Generator().manual_seed(0)
    J = model.linearize(state).manipulation_jacobian
    for _ in range(40):
        da = 2 * DEG * torch.randn(n_a, generator=generator, dtype=torch.float64)
        da[torch.arange(n_a) % 2 == 0] = 0.0  # only every other actuator was ever moved
        enhanced.update(state, da, 1.2 * J @ da, J @ da)
    return enhanced


def decide(grasp, taught: EnhancedModel, **options: float):
    plant, _, seen, state = grasp
    target = PoseTarget.turned(state, plant.rotation_axis, 10 * DEG)
    focus = FocusedPose.rotation_about(plant.rotation_axis)
    loop = LookAndMoveController(taught, focus, ControllerOptions(**options))
    decision = loop.decide(state, seen.a, target, seen.fingertip_force)
    weight = torch.cat([torch.zeros(plant.hand.n_q + 3), plant.rotation_axis.square()]).double()
    return loop, decision, float(taught.variance(state, decision.delta_a, weight).value) / DEG**2


def test_without_weight_nothing_changes(grasp, taught: EnhancedModel) -> None:
    plain, zero = (decide(grasp, taught, **o)[1] for o in ({}, {"uncertainty_weight": 0.0}))
    assert torch.equal(plain.delta_a, zero.delta_a)


def test_uncertain_actions_are_avoided_at_little_cost(grasp, taught: EnhancedModel) -> None:
    plant = grasp[0]
    runs = [decide(grasp, taught, uncertainty_weight=w) for w in (0.0, 3.0, 30.0)]
    variances = [variance for _, _, variance in runs]
    assert variances[1] < 0.8 * variances[0]
    assert variances[2] < 0.6 * variances[0]
    for _, decision, _ in runs:  # what was asked for is still met
        turn = float(plant.rotation_axis @ decision.predicted[-3:])
        assert turn == pytest.approx(STEP, rel=5e-3)


def test_decision_is_the_best_of_all(grasp, taught: EnhancedModel) -> None:
    """The QP's cost with the true variance, at the decision and at random steps that turn as far."""
    plant, _, seen, state = grasp
    options = {"uncertainty_weight": 30.0, "sqp_iterations": 40}
    loop, decision, _ = decide(grasp, taught, **options)
    error = PoseTarget.turned(state, plant.rotation_axis, 10 * DEG).error(state)
    lin = decision.linearization
    value, J = taught.linearize(state, decision.delta_a, lin.manipulation_jacobian)
    problem = loop._problem(
        state, seen.a, error, decision.desired, lin, J, value - J @ decision.delta_a, seen.fingertip_force
    )
    weight = torch.cat([torch.zeros(plant.hand.n_q + 3), plant.rotation_axis.square()]).double()

    def cost(u: np.ndarray) -> float:
        total = float(u @ problem.weight @ u)
        total += sum(float(w @ (A @ u - b) ** 2) for A, b, w in problem.least_squares)
        broken = sum(np.maximum(C @ u - h, 0).sum() for C, h in problem.soft_inequality)
        da = torch.from_numpy(u * DEG)
        # brute force: the variance that the learner itself predicts
        law = taught.predict(state, da)
        variance = float(weight[-6:] @ law.variance) / DEG**2
        return total + problem.soft_penalty * float(broken) + 30.0 * variance

    best = decision.delta_a.numpy() / DEG
    E, _ = problem.equality
    free = np.linalg.svd(E)[2][len(E) :].T  # steps that leave the focused motion alone
    generator = np.random.default_rng(0)
    found = cost(best)
    for size in (1e-2, 0.1, 1.0):
        for _ in range(40):
            u = best + free @ (size * generator.normal(size=free.shape[1]))
            u = np.where((u >= problem.lower) & (u <= problem.upper), u, best)
            if np.abs(E @ (u - best)).max() < 1e-9:
                assert cost(u) > found - 1e-4 * size


def test_learner_without_uncertainty_is_refused(grasp, taught: EnhancedModel) -> None:
    plant, model, _, _ = grasp
    rows = list(range(plant.hand.n_q, plant.hand.n_q + 6))
    never_unsure = EnhancedModel(
        model, ZeroResidual(6 + plant.hand.n_a, 6), encode=lambda s: s.coordinates(s)[..., -6:], outputs=rows
    )
    with pytest.raises(ParameterError, match="ZeroResidual"):
        decide(grasp, never_unsure, uncertainty_weight=1.0)


def test_margin_rows_keep_away_from_the_friction_cone(grasp) -> None:
    plant, _, seen, state = grasp
    target = PoseTarget.turned(state, plant.rotation_axis, 10 * DEG)
    free = controller(grasp).decide(state, seen.a, target, seen.fingertip_force)
    lin = free.linearization

    def after(decision) -> torch.Tensor:
        return lin.margins + lin.margin_sensitivity @ decision.delta_a

    bound = float(after(free).min()) + 0.2
    kept = controller(grasp, ControllerOptions(margin_min=bound)).decide(
        state, seen.a, target, seen.fingertip_force
    )
    assert float(after(kept).min()) > bound - 1e-4
    assert float(plant.rotation_axis @ kept.predicted[-3:]) == pytest.approx(STEP, rel=1e-4)
    # far more than can be had: as much as one step may ask for, and the turn is still made
    much = ControllerOptions(margin_min=50.0)
    decision = controller(grasp, much).decide(state, seen.a, target, seen.fingertip_force)
    assert decision.status is StopReason.RUNNING
    assert decision.solution is not None
    assert float((after(decision) - lin.margins).min()) > float((after(free) - lin.margins).min())
