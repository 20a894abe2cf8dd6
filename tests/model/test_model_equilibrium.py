"""The exact solver against answers that it does not share a line of code with."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from model_toys import F64, planar_two_finger, soft_two_finger, three_finger

from torch_ekm.contact.contact_kinematics import constraint_matrix
from torch_ekm.exceptions import EquilibriumError, ParameterError
from torch_ekm.kinematics.se3 import exp


def test_pinned_equilibria_minimise_the_energy():
    # independent: SLSQP on the potential, contact points glued together, no Jacobian of ours
    scipy_optimize = pytest.importorskip("scipy.optimize")
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
    best = scipy_optimize.minimize(
        energy, x0, method="SLSQP", constraints={"type": "eq", "fun": constraints}, options={"ftol": 1e-15}
    )
    q, o, R = unpack(best.x)
    assert (found.state.q - q).abs().max() < 1e-5
    assert (found.state.position - o).abs().max() < 1e-6
    assert (found.state.rotation - R).abs().max() < 1e-5
    assert (found.state.q - toy.state.q).abs().max() > 1e-3  # it did move


@pytest.mark.parametrize("make", [planar_two_finger, three_finger, soft_two_finger])
def test_the_solution_satisfies_every_equation(make):
    toy = make()
    solver, start = toy.solver(), toy.equilibrium()
    a = start.a + 0.3e-3 * torch.linspace(-1, 1, len(start.a), dtype=F64) / toy.unit
    end = solver.move(start, a)
    assert torch.allclose(solver.actuators(end.state), a, atol=1e-12)
    contacts = solver.surfaces(end.state.q, end.state.position, end.state.rotation)
    assert contacts.gap.abs().max() < 1e-12
    kin = toy.model.contact_kinematics(end.state, contacts)
    A, n_q = constraint_matrix(kin), len(end.state.q)
    torque = toy.model.spring_stiffness * (end.state.q - toy.model.spring_rest)
    joint = torque + A[:, :n_q].mT @ end.mu + toy.model.reduction.actuation.mT @ end.lam
    assert joint.abs().max() < 1e-11
    weight, lever = toy.model.weight, end.state.rotation @ toy.model.com
    gravity = torch.cat([weight, torch.linalg.cross(lever, weight)])
    assert (toy.model.reduction.pose_basis.mT @ (gravity - A[:, n_q:].mT @ end.mu)).abs().max() < 1e-11


def test_planar_motion_can_be_undone_and_spatial_rolling_depends_on_the_path():
    def loop(toy, size):
        solver, at = toy.solver(max_step=2e-3), toy.equilibrium()
        n_a = len(at.a)
        one, two = size * torch.eye(n_a, dtype=F64)[:2]
        for step in (one, two, -one, -two):
            at = solver.move(at, at.a + step)
        return float((at.state.minus(toy.state)).abs().max())

    assert loop(planar_two_finger(), 6e-3) < 1e-8
    assert loop(planar_two_finger(pinned=True), 6e-3) < 1e-8
    assert loop(soft_two_finger(), 1e-2) > 1e-5


def test_midpoint_steps_converge_with_second_order():
    toy = three_finger()
    start = toy.equilibrium()
    a = start.a + torch.tensor([3e-4, -1e-4, 2e-4], dtype=F64) / toy.unit
    ends = []
    for step in (1.5e-4, 0.75e-4, 2.5e-5):
        ends.append(toy.solver(max_step=step).move(start, a).state)
    errors = [float(e.minus(ends[-1]).abs().max()) for e in ends[:-1]]
    assert 3.5 < errors[0] / errors[1] < 4.6


def test_find_fades_out_what_the_joints_cannot_explain():
    toy = three_finger()
    solver = toy.solver()
    found = solver.find(torch.full((3,), 0.8, dtype=F64))
    assert found.residual < 1e-10
    assert found.contacts.gap.abs().max() < 1e-10
    forces = solver.forces(found)
    assert (forces.normal > 0).all()


def test_grip_reaches_the_wished_normal_forces():
    toy = three_finger()
    solver = toy.solver()
    at = solver.grip(toy.equilibrium(), torch.tensor([1.15, float("nan"), float("nan")], dtype=F64))
    assert float(solver.forces(at).normal[0]) == pytest.approx(1.15, abs=1e-6)


def test_beyond_the_fold_there_is_no_equilibrium():
    toy = planar_two_finger()
    with pytest.raises(EquilibriumError, match="% of the way"):
        toy.solver().move(toy.equilibrium(), toy.equilibrium().a + 5)


def test_a_flat_finger_is_refused():
    toy = three_finger()
    flat = toy.contacts.replace(finger_curvature=torch.zeros(3, 3, 3, dtype=F64))
    with pytest.raises(ParameterError, match="ball"):
        dataclasses.replace(toy, contacts=flat).solver()


def test_no_forces_no_equilibrium():
    toy = three_finger()
    slippery = toy.contacts.replace(friction=torch.full((3,), 0.01, dtype=F64))
    with pytest.raises(EquilibriumError, match="not_graspable"):
        dataclasses.replace(toy, contacts=slippery).solver().find()
