"""J_m against finite differences of exact nonlinear equilibria: planar, spatial, pinned, rolling, soft.

What is checked here can fail: leaving out S and T, or rolling, breaks both the Jacobian and the
order of convergence.
"""

from __future__ import annotations

import dataclasses

import pytest
import torch
from missing_terms import without
from model_toys import (
    finite_difference_jacobian,
    planar_two_finger,
    relative_error,
    soft_two_finger,
    step_error_slope,
    three_finger,
)

from torch_ekm.model import KinematicModel

STEP = 2e-5  # of tendon travel [m]
GRASPS = {
    "planar pinned": lambda: planar_two_finger(pinned=True),
    "planar rolling": planar_two_finger,
    "spatial pinned": lambda: three_finger(pinned=True, grip=0.4),
    "spatial rolling": three_finger,
    "spatial soft": soft_two_finger,
    "soft on balls": lambda: soft_two_finger(k_o=30.0),
    "compliant tendons": lambda: three_finger(stiffness=2e4),
}
_CACHE: dict = {}


def case(name):
    if name not in _CACHE:
        toy = GRASPS[name]()
        solver, start = toy.solver(), toy.equilibrium()
        _CACHE[name] = toy, solver, start, finite_difference_jacobian(solver, start, STEP)
    return _CACHE[name]


def variant(toy, **changes) -> KinematicModel:
    model = toy.model
    options = dataclasses.replace(model.options, on_unstable="flag", **changes)
    return KinematicModel(
        model.hand, model.obj, options, kinematics=model.kinematics, detector=model.detector
    )


@pytest.mark.parametrize("name", GRASPS)
def test_jacobian_equals_finite_differences_of_exact_equilibria(name):
    toy, _, _, truth = case(name)
    J = toy.model.linearize(toy.state, forces=toy.forces()).manipulation_jacobian
    assert relative_error(J, truth, len(toy.state.q)) < 1e-8


@pytest.mark.parametrize("name", GRASPS)
def test_forces_and_jacobian_from_the_state_alone(name):
    toy, _, _, truth = case(name)
    lin = toy.model.linearize(toy.state)
    assert lin.forces.solved
    assert (lin.forces.mu - toy.mu).norm() < 1e-4 * toy.mu.norm()
    assert (lin.forces.lam - toy.lam).norm() < 1e-4 * toy.lam.norm()
    assert relative_error(lin.manipulation_jacobian, truth, len(toy.state.q)) < 1e-4


@pytest.mark.parametrize("name", GRASPS)
def test_force_sensitivities_equal_finite_differences(name):
    toy, solver, start, _ = case(name)
    lin = toy.model.linearize(toy.state, forces=toy.forces())

    def read(e):
        forces = solver.forces(e)
        return torch.cat([e.lam, forces.normal, forces.margin])

    truth = finite_difference_jacobian(solver, start, STEP, read)
    n_a, n_c = len(start.a), toy.contacts.n_c
    ours = [lin.actuator_force_sensitivity, lin.normal_force_sensitivity, lin.margin_sensitivity]
    smooth = lin.forces.relative_margin < 0.99  # |f_t| has a kink at f_t = 0, where differences mean nothing
    assert smooth.any()
    for part, expected in zip(ours, truth.split([n_a, n_c, n_c]), strict=True):
        rows = smooth if part is ours[-1] else slice(None)
        assert (part - expected)[rows].norm() < 1e-6 * expected[rows].norm()


@pytest.mark.parametrize("name", ["planar rolling", "spatial pinned", "spatial rolling", "spatial soft"])
def test_the_error_of_a_step_is_of_second_order_and_of_first_when_a_term_is_missing(name):
    toy, solver, start, _ = case(name)
    n_a = len(start.a)
    directions = torch.eye(n_a, dtype=torch.float64)[:2]
    sizes = [1e-5, 2e-5, 4e-5] if "pinned" in name else [2e-5, 4e-5, 8e-5]
    J = toy.model.linearize(toy.state, forces=toy.forces()).manipulation_jacobian
    slopes = step_error_slope(solver, start, J, directions, sizes)
    assert ((slopes > 1.95) & (slopes < 2.05)).all(), slopes
    missing = [("S", "T")]
    if "pinned" not in name:
        missing.append(("rolling",))
    for terms in missing:
        J = without(toy.model, *terms).linearize(toy.state, forces=toy.forces()).manipulation_jacobian
        slopes = step_error_slope(solver, start, J, directions, sizes)
        assert (slopes < 1.2).all(), (terms, slopes)


@pytest.mark.parametrize("name", ["planar rolling", "spatial rolling", "spatial soft", "soft on balls"])
def test_each_term_matters(name):
    toy, _, _, truth = case(name)
    errors = {}
    for term in ("S", "T", "rolling"):
        J = without(toy.model, term).linearize(toy.state, forces=toy.forces()).manipulation_jacobian
        errors[term] = relative_error(J, truth, len(toy.state.q))
    assert min(errors.values()) > 5e-3, errors


def test_gravity_and_the_centre_of_mass_enter():
    toy, _, _, truth = case("spatial rolling")
    n_q = len(toy.state.q)
    hand = dataclasses.replace(toy.model.hand, gravity=(0.0, 0.0, 0.0))
    given = {"kinematics": toy.model.kinematics, "detector": toy.model.detector}
    J = (
        KinematicModel(hand, toy.model.obj, toy.model.options, **given)
        .linearize(toy.state, forces=toy.forces())
        .manipulation_jacobian
    )
    assert relative_error(J, truth, n_q) > 1e-4
