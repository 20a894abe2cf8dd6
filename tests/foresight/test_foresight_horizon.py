"""Plans: the reference loop's way, another solver's optimum, and where one motion is enough, one step's."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from planar import planar
from test_foresight_rollout import AXIS, started
from turning import turning

from torch_ekm.control import (
    ActuatorLimit,
    EffortTask,
    FocusTask,
    LimitingFunction,
    LookAndMoveController,
    OffAxisTask,
    PoseTarget,
    StopReason,
)
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import ParameterError
from torch_ekm.foresight import HorizonController, Rollout
from torch_ekm.foresight.configuration import Configuration
from torch_ekm.foresight.limits import SlipLimit
from torch_ekm.foresight.path import Path, PathModel, joined

F64 = torch.float64
DEG = math.pi / 180
NORMAL = torch.tensor([0.0, 0.0, 1.0], dtype=F64)


def test_linearizing_a_whole_path_at_once_gives_the_way_of_the_loop():
    model, _, at, lin = started()
    enhanced = EnhancedModel.for_grasp(model, at.state)
    w = turning(lin, AXIS, 1.5 * DEG)
    for _ in range(5):
        enhanced.update(at.state, w, 1.2 * lin.step(w), lin.step(w))
    actions = w + 0.3 * DEG * torch.randn(8, len(w), dtype=F64, generator=torch.Generator().manual_seed(0))
    expected = Rollout(enhanced).predict(at.state, actions, start=lin)
    paths, start = PathModel(model, enhanced), Configuration.of(lin)
    middles, nodes = paths.steps(start, lin, 8 * w, lin.step(8 * w), 8)  # a straight guess
    path, errors = Path(actions, joined(start.expand(1), nodes), middles, torch.zeros(8, at.state.n_s)), []
    for _ in range(8):
        path = paths.follow(start, paths.linearize(path), actions)
        errors.append(float((path.nodes.state.position - expected.states.position).abs().max()))
    assert errors[0] < 1e-3  # [m], after one batched linearization
    assert errors[-1] < 1e-8
    assert (path.nodes.forces.force - expected.force).abs().max() < 1e-5
    assert (path.nodes.contacts.point - expected.contacts.point).abs().max() < 1e-8


def plan(horizon=3, **options):
    """A block turned by 6 deg, in motions of at most 2, as the planar hand's controller plans it."""
    model, a, lin = planar()
    target = PoseTarget.turned(lin.state, NORMAL, degrees=6.0)
    tasks = (EffortTask(), OffAxisTask(rotation_step=math.inf, translation_step=math.inf), FocusTask())
    controller = HorizonController(
        model,
        NORMAL,
        tasks,
        (ActuatorLimit(),),
        LimitingFunction(gain=1.0, step=2 * DEG, contact_travel=None),
        horizon=horizon,
        along=(),
        **options,
    )
    controller._linearize = lambda *_: lin  # the exact forces
    return controller, target, a, lin


def test_a_plan_is_the_optimum_that_another_solver_finds():
    casadi = pytest.importorskip("casadi")
    controller, target, a, lin = plan(sqp_iterations=20, sqp_tolerance=1e-9)
    decision = controller.decide(lin.state, a, target)
    assert decision.status is StopReason.RUNNING
    found = (controller.plan.actions / DEG).numpy()
    rollout, K, n_a = Rollout(controller.kinematic), *found.shape
    off, M = controller.focus.off_matrix, controller.focus.matrix
    translation = controller.focus.off_translation
    weight = torch.where(translation, 0.05 / 1e-6, 0.3 / DEG**2).to(F64)

    def outcomes(w: np.ndarray) -> np.ndarray:
        """Cost, and the turn of each motion [deg]; a batch of sequences."""
        actions = torch.as_tensor(w.reshape(-1, K, n_a)) * DEG
        p = rollout.predict(lin.state, actions, start=lin)
        cost = 1e-2 * (actions / DEG).square().sum((-2, -1))
        cost = cost + (weight * p.turned(off)[..., 1:, :].square()).sum((-2, -1))
        return torch.cat([cost[:, None], p.turned(M)[..., 0].diff(dim=-1) / DEG], dim=-1).numpy()

    class Outcome(casadi.Callback):
        """Value by the rollout, Jacobian by a batch of them."""

        def __init__(self, derivative=False):
            super().__init__()
            self.derivative = derivative
            self.construct("jac_outcome" if derivative else "outcome", {})

        def get_n_in(self):
            return 2 if self.derivative else 1

        def get_sparsity_in(self, i):
            return casadi.Sparsity.dense(K * n_a if i == 0 else K + 1, 1)

        def get_sparsity_out(self, i):
            return casadi.Sparsity.dense(K + 1, K * n_a if self.derivative else 1)

        def has_jacobian(self):
            return not self.derivative

        def get_jacobian(self, *_):
            self.jacobian_of = Outcome(derivative=True)
            return self.jacobian_of

        def eval(self, arguments):
            w = np.array(arguments[0]).ravel()
            if not self.derivative:
                return [outcomes(w)[0]]
            step = 1e-4 * np.eye(len(w))
            ends = outcomes(np.concatenate([w + step, w - step]))
            return [((ends[: len(w)] - ends[len(w) :]) / 2e-4).T]

    w, outcome = casadi.MX.sym("w", K * n_a), Outcome()
    y = outcome(w)
    problem = {"x": w, "f": y[0], "g": casadi.vertcat(casadi.sum1(y[1:]), y[1:])}
    quiet = {"print_level": 0, "hessian_approximation": "limited-memory", "tol": 1e-8, "sb": "yes"}
    solver = casadi.nlpsol("oracle", "ipopt", problem, {"ipopt": quiet, "print_time": False})
    solution = solver(x0=np.zeros(K * n_a), lbg=[6.0] + [0.95 * 6.0 / K] * K, ubg=[6.0] + [2.0] * K)
    best = np.array(solution["x"]).reshape(K, n_a)
    assert np.abs(found - best).max() < 0.02 * np.abs(best).max()
    assert outcomes(found.ravel())[0, 0] < 1.001 * float(solution["f"])
    assert abs(outcomes(found.ravel())[0, 1:].sum() - 6.0) < 0.01  # [deg]: the goal stands at the end


def test_where_one_motion_is_enough_it_is_that_of_look_and_move():
    model, a, lin = planar()
    target = PoseTarget.turned(lin.state, NORMAL, degrees=2.0)
    one, many = LookAndMoveController(model, NORMAL), HorizonController(model, NORMAL)
    assert torch.equal(one.decide(lin.state, a, target).delta_a, many.decide(lin.state, a, target).delta_a)
    assert many.plan is None


def test_the_plan_goes_as_far_as_its_horizon_and_is_as_long_as_the_way():
    controller, target, a, lin = plan()
    controller.decide(lin.state, a, target)
    way = Rollout(controller.kinematic).predict(lin.state, controller.plan.actions, start=lin)
    steps = way.turned(controller.focus.matrix)[:, 0].diff()
    assert len(steps) == 3
    assert steps.max() < 2.02 * DEG
    assert steps.sum() == pytest.approx(6 * DEG, abs=0.05 * DEG)
    controller, target, a, lin = plan(horizon=2)
    controller.decide(lin.state, a, target)
    assert len(controller.plan.actions) == 2
    controller.reset()
    assert controller.plan is None
    with pytest.raises(ParameterError, match="horizon"):
        plan(horizon=0)


def test_a_plan_finds_a_way_on_which_contacts_do_not_slide():
    model, solver, at, lin = started()
    lin = dataclasses.replace(lin, contacts=lin.contacts.replace(finger=("thumb", "index", "middle")))
    target = PoseTarget.turned(at.state, AXIS, degrees=8)
    least = []
    for along in ((), (SlipLimit(),)):
        controller = HorizonController(model, AXIS, along=along)
        controller._linearize = lambda *_: lin  # the exact forces
        controller.decide(at.state, solver.actuators(at.state), target)
        least.append(float(Rollout(model).predict(at.state, controller.plan.actions, start=lin).margin.min()))
    assert least[0] < -0.5  # [N]; measured -1.2
    assert least[1] > -0.2  # measured -.13 after two programs, -.01 after a third
