"""An E-KM that knows some actuators better than others, and decisions that heed it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torch_ekm.control import (
    DEFAULT_TASKS,
    FocusedPose,
    LimitingFunction,
    LinearizedModel,
    LookAndMoveController,
    PoseTarget,
    Situation,
    StepBound,
    UncertaintyTask,
)
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import ParameterError
from torch_ekm.residual import ActionLinearKernel, SparseOnlineGP, ZeroResidual

DEG = math.pi / 180
STEP = LimitingFunction().step
#: The model's own doubts about a step are another matter.
WHOLE = StepBound(least=math.inf)


@pytest.fixture(scope="module")
def taught(grasp) -> EnhancedModel:
    """An E-KM with an action-linear kernel that knows some of the actuators well and others not at all."""
    plant, model, _, state = grasp
    n_q, n_a = plant.hand.n_q, plant.hand.n_a
    kernel = ActionLinearKernel(6 + n_a, n_a, action_variance=0.1)
    learner = SparseOnlineGP(6 + n_a, 6, kernel=kernel, noise_variance=0.05, parts=(), standardize=False)
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


def decide(grasp, taught: EnhancedModel, weight: float | None = None, **options: int):
    plant, _, seen, state = grasp
    target = PoseTarget.turned(state, plant.rotation_axis, 10 * DEG)
    focus = FocusedPose.rotation_about(plant.rotation_axis)
    more = () if weight is None else (UncertaintyTask(weight),)
    loop = LookAndMoveController(taught, focus, (*DEFAULT_TASKS, *more), bound=WHOLE, **options)
    decision = loop.decide(state, seen.a, target, seen.fingertip_force)
    about = torch.cat([torch.zeros(plant.hand.n_q + 3), plant.rotation_axis.square()]).double()
    return loop, decision, float(taught.variance(state, decision.delta_a, about).value) / DEG**2


def test_without_weight_nothing_changes(grasp, taught: EnhancedModel) -> None:
    plain, zero = (decide(grasp, taught, weight)[1] for weight in (None, 0.0))
    assert torch.equal(plain.delta_a, zero.delta_a)


def test_uncertain_actions_are_avoided_at_little_cost(grasp, taught: EnhancedModel) -> None:
    plant = grasp[0]
    runs = [decide(grasp, taught, w) for w in (0.0, 3.0, 30.0)]
    variances = [variance for _, _, variance in runs]
    assert variances[1] < 0.8 * variances[0]
    assert variances[2] < 0.6 * variances[0]
    for _, decision, _ in runs:  # what was asked for is still met
        turn = float(plant.rotation_axis @ decision.predicted[-3:])
        assert turn == pytest.approx(STEP, rel=5e-3)


def test_decision_is_the_best_of_all(grasp, taught: EnhancedModel) -> None:
    """The QP's cost with the true variance, at the decision and at random steps that turn as far."""
    plant, _, seen, state = grasp
    loop, decision, _ = decide(grasp, taught, 30.0, sqp_iterations=40)
    error = PoseTarget.turned(state, plant.rotation_axis, 10 * DEG).error(state)
    at = Situation(plant.hand, loop.focus, state, seen.a, seen.fingertip_force, error, decision.desired)
    value, J = taught.linearize(state, decision.delta_a, decision.linearization.manipulation_jacobian)
    model = LinearizedModel(decision.linearization, decision.delta_a, value - J @ decision.delta_a, J)
    loop.tasks = loop.tasks[:-1]  # all but the variance, which is added by brute force
    qp = loop.program(model, at).qp
    n_u, n_t = plant.hand.n_a, len(qp.h)
    P, q, E, C = qp.P[:n_u, :n_u], qp.q[:n_u], qp.A[:, :n_u], qp.G[:, :n_u]
    lower, upper = qp.lb[:n_u], qp.ub[:n_u]
    weight = torch.cat([torch.zeros(plant.hand.n_q + 3), plant.rotation_axis.square()]).double()

    def cost(u: np.ndarray) -> float:
        broken = qp.q[-n_t:] @ np.maximum(C @ u - qp.h, 0)
        law = taught.predict(state, torch.from_numpy(u * DEG))  # what the learner itself predicts
        variance = float(weight[-6:] @ law.variance) / DEG**2
        return float(0.5 * u @ P @ u + q @ u + broken) + 30.0 * variance

    best = decision.delta_a.numpy() / DEG
    free = np.linalg.svd(E)[2][len(E) :].T  # steps that leave the focused motion alone
    generator = np.random.default_rng(0)
    found = cost(best)
    for size in (1e-2, 0.1, 1.0):
        for _ in range(40):
            u = best + free @ (size * generator.normal(size=free.shape[1]))
            u = np.where((u >= lower) & (u <= upper), u, best)
            if np.abs(E @ (u - best)).max() < 1e-9:
                assert cost(u) > found - 1e-4 * size


def test_uncertainty_task_costs_the_variance_that_the_learner_predicts(grasp, taught: EnhancedModel) -> None:
    plant, km, seen, state = grasp
    n_a = plant.hand.n_a
    at = Situation(
        plant.hand,
        FocusedPose.rotation_about(plant.rotation_axis),
        state,
        seen.a,
        None,
        torch.zeros(6).double(),
        torch.zeros(1).double(),
    )
    generator = torch.Generator().manual_seed(1)
    action, u = 2 * DEG * torch.randn(2, n_a, generator=generator, dtype=torch.float64)
    rows = UncertaintyTask(3.0).rows(LinearizedModel.about(action, km.linearize(state), taught), at)
    variance = plant.rotation_axis.square() @ taught.predict(state, u).variance[-3:]
    # no action, no doubt: the constant that the rows leave out is zero
    torch.testing.assert_close(u @ rows.curvature @ u / 2 + rows.gradient @ u, 3.0 * variance / DEG**2)


def test_learner_without_uncertainty_is_refused(grasp, taught: EnhancedModel) -> None:
    plant, model, _, _ = grasp
    rows = list(range(plant.hand.n_q, plant.hand.n_q + 6))
    never_unsure = EnhancedModel(
        model, ZeroResidual(6 + plant.hand.n_a, 6), encode=lambda s: s.coordinates(s)[..., -6:], outputs=rows
    )
    with pytest.raises(ParameterError, match="ZeroResidual"):
        decide(grasp, never_unsure, 1.0)
