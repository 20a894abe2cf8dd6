"""J_m against finite differences of exact equilibria, and these against the least energy."""

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch
from model_icub import gripped
from model_toys import (
    F64,
    Toy,
    changed,
    finite_difference_jacobian,
    planar_two_finger,
    relative_error,
    soft_two_finger,
    three_finger,
)
from scipy.optimize import minimize

from torch_ekm.contact.contacts import contact_frames
from torch_ekm.kinematics.se3 import exp

STEP = 2e-5  # [rad] of a motor


def toy(make, **options):
    grasp = make(**options)
    return grasp, grasp.solver(), grasp.equilibrium()


def crossed(make, angle=0.9, rho=0.008, radius=0.02):
    """Finger and object are cylinders whose axes cross under ``angle`` [rad] at every contact."""
    grasp = make()
    c = grasp.contacts
    frame = contact_frames(c.normal)
    t1, t2 = frame[..., 1], frame[..., 2]
    tangent = torch.eye(3, dtype=F64) - c.normal[..., :, None] * c.normal[..., None, :]

    def cylinder(turn, r):
        axis = math.cos(turn) * t1 + math.sin(turn) * t2
        return (tangent - axis[..., :, None] * axis[..., None, :]) / r

    contacts = c.replace(finger_curvature=cylinder(0.4, rho), object_curvature=cylinder(0.4 + angle, radius))
    grasp = dataclasses.replace(grasp, model=changed(grasp.model, contacts=contacts), contacts=contacts)
    solver = grasp.solver()
    assert {core.directions.shape for core in solver.surfaces.finger + solver.surfaces.object} == {(3, 1)}
    return grasp, solver, grasp.equilibrium()


def icub(shape, **options):
    """20 joints, couplings, 9 compliant actuators."""
    model, solver, at = gripped(shape, **options)
    model = changed(model, contacts=at.contacts)
    return Toy(model, at.state, at.contacts, at.mu, at.lam, at.a), solver, at


GRASPS = {
    "planar pinned": lambda: toy(planar_two_finger, pinned=True),
    "planar rolling": lambda: toy(planar_two_finger),
    "spatial pinned": lambda: toy(three_finger, pinned=True, grip=0.4),
    "spatial rolling": lambda: toy(three_finger),
    "spatial soft": lambda: toy(soft_two_finger),
    "soft on balls": lambda: toy(soft_two_finger, k_o=30.0),
    "compliant tendons": lambda: toy(three_finger, stiffness=2e4),
    "crossed cylinders": lambda: crossed(three_finger),
    "soft crossed cylinders": lambda: crossed(soft_two_finger),
    "iCub box": lambda: icub("box"),
    "iCub can": lambda: icub("can"),
    "soft iCub box": lambda: icub("box", gamma=0.004),
}


@functools.cache
def case(name):
    """A grasp, and its true derivatives of the state, of the normal forces and margins."""
    grasp, solver, start = GRASPS[name]()

    def read(e):
        forces = solver.forces(e)
        return torch.cat([e.state.minus(start.state), forces.normal, forces.margin])

    truth = finite_difference_jacobian(solver, start, STEP, read)
    n_c = grasp.contacts.n_c
    return grasp, truth.split([start.state.n_s, n_c, n_c])


@pytest.mark.parametrize("name", GRASPS)
def test_jacobian_and_force_sensitivities_equal_finite_differences(name):
    grasp, (J, normal, margin) = case(name)
    lin = grasp.model.linearize(grasp.state, forces=grasp.forces())
    assert relative_error(lin.manipulation_jacobian, J, lin.n_q) < 1e-8
    assert (torch.as_tensor(grasp.model.hand.coupling) @ lin.joint_jacobian).abs().sum() < 1e-12
    assert (lin.normal_force_sensitivity - normal).norm() < 1e-6 * normal.norm()
    smooth = lin.forces.relative_margin < 0.99  # |f_t| has a kink at f_t = 0, where differences mean nothing
    assert smooth.any()
    slopes = torch.autograd.functional.jacobian(lin.margins_after, torch.zeros(J.shape[1], dtype=F64))
    assert (slopes - margin)[smooth].norm() < 1e-6 * margin[smooth].norm()


@pytest.mark.parametrize("name", [name for name in GRASPS if name != "soft iCub box"])  # on its cones
def test_forces_and_jacobian_from_the_state_alone(name):
    grasp, (J, *_) = case(name)
    lin = grasp.model.linearize(grasp.state)
    assert lin.forces.solved
    assert lin.forces.residual.abs().max() < 1e-5
    assert (lin.forces.mu - grasp.mu).norm() < 1e-4 * grasp.mu.norm()
    assert (lin.forces.lam - grasp.lam).norm() < 1e-4 * grasp.lam.norm()
    assert relative_error(lin.manipulation_jacobian, J, lin.n_q) < 1e-4


def test_pinned_equilibria_minimise_the_energy():
    # independent: SLSQP on the potential, contact points glued together, no Jacobian of ours
    toy = planar_two_finger(pinned=True)
    solver, start = toy.solver(), toy.equilibrium()
    a = start.a + torch.tensor([0.4e-3, -0.2e-3], dtype=F64) / toy.unit
    found = solver.move(start, a)
    model = toy.model
    kin, links = model.kinematics, [model.link_names.index(name) for name in toy.contacts.link]
    poses = kin(toy.state.q).transforms[links]
    on_finger = (poses[:, :3, :3].mT @ (toy.contacts.point - poses[:, :3, 3])[..., None])[..., 0]
    on_object = (toy.contacts.point - toy.state.position) @ toy.state.rotation

    def unpack(x):
        x = torch.tensor(x, dtype=F64)
        o = toy.state.position + torch.cat([x[4:6], x.new_zeros(1)]) * 0.03
        return x[:4], o, exp(torch.stack([x.new_zeros(()), x.new_zeros(()), x[6]]))

    def energy(x):
        q, o, R = unpack(x)
        spring = 0.5 * (model.spring_stiffness * (q - model.spring_rest) ** 2).sum()
        return float(spring - model.weight @ (o + R @ model.com))

    def constraints(x):
        q, o, R = unpack(x)
        T = kin(q).transforms[links]
        finger = T[:, :3, 3] + (T[:, :3, :3] @ on_finger[..., None])[..., 0]
        closing = (finger - o - on_object @ R.mT)[:, :2].flatten() / 0.03
        tendons = model.reduction.actuation @ q - a
        return torch.cat([closing, tendons]).numpy()

    x0 = np.concatenate([toy.state.q.numpy(), np.zeros(3)])
    best = minimize(
        energy, x0, method="SLSQP", constraints={"type": "eq", "fun": constraints}, options={"ftol": 1e-15}
    )
    q, o, R = unpack(best.x)
    assert (found.state.q - q).abs().max() < 1e-5
    assert (found.state.position - o).abs().max() < 1e-6
    assert (found.state.rotation - R).abs().max() < 1e-5
    assert (found.state.q - toy.state.q).abs().max() > 1e-3  # it did move
